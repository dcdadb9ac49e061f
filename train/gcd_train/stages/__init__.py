"""The steps of a run, in their order: vae, latents, unet, decoder, export."""
