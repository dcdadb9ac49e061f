"""The driving world: streets with traffic, seen from a vehicle; as pairs of clips and as whole drives."""
