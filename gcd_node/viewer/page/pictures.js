// The two pictures: decoding, playing windows at their rate, overlays, and how old everything is.

import { seconds } from "./link.js";
import { ClassOverlay, DepthOverlay, DeviationOverlay, VisibilityOverlay, sized } from "./overlays.js";

const REMEMBERED_MS = 120000; // previews kept, to show the input of the view's moment
const SILENT_MS = 2000; // no preview for so much longer than it is valid: the input has stopped
const PATIENCE_MS = 250; // how long a window waits for its maps
const CLOSE_S = 0.35; // a preview of "the same moment" is at most so far from it
const element = (id) => document.getElementById(id);

async function frames(head, bytes) {
  const cut = head.offsets.slice(1).map((end, i) => new Blob([bytes.subarray(head.offsets[i], end)], { type: "image/jpeg" }));
  return Promise.all(cut.map((each) => createImageBitmap(each)));
}

async function unpacked(bytes) {
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

class Stage {
  constructor(name) {
    this.canvas = element(`${name}-picture`);
    this.box = this.canvas.parentElement;
    this.badge = element(`${name}-badge`);
    this.veil = element(`${name}-veil`);
  }

  draw(bitmap) {
    sized(this.canvas, bitmap.width, bitmap.height).drawImage(bitmap, 0, 0);
    this.box.dataset.empty = "false";
  }

  // text: on the picture. over: across it, for a picture that must not be used any more.
  label(text, over) {
    if (this.badge.textContent !== text) this.badge.textContent = text;
    if (this.veil.textContent !== over) this.veil.textContent = over;
    this.box.dataset.old = String(over !== "");
  }

  clear(text) {
    this.box.dataset.empty = "true";
    this.label(text, "");
  }
}

// What the camera sees, as it comes, or as it was at the view's moment.
export class InputPicture {
  constructor() {
    this.stage = new Stage("input");
    this.past = []; // {head, coded, at}: as JPEG, which is small
    this.shown = null;
    this.wanted = null; // what is being decoded
    this.mode = "live";
    element("moment").addEventListener("change", (event) => { this.mode = event.target.value; });
  }

  take(head, bytes, at) {
    if (this.past.length && this.past.at(-1).head.boot_id !== head.boot_id) this.past = [];
    this.past.push({ head, coded: new Blob([bytes], { type: "image/jpeg" }), at });
    while (at - this.past[0].at > REMEMBERED_MS) this.past.shift();
    element("input-facts").textContent = `${head.src.kind} ${head.src.id}, ${head.src.fps_in.toFixed(1)} FPS`;
  }

  // playing: the frame of the view that is on the screen, to find its moment; null if there is none.
  refresh(now, playing, isDead) {
    const isLive = this.mode === "live" || !playing;
    const wanted = isLive ? this.past.at(-1) : this.nearest(playing);
    if (!wanted) {
      this.shown = this.wanted = null;
      return this.stage.clear(isLive ? "no input yet" : "that moment is not remembered here");
    }
    if (wanted !== this.wanted) this.show(wanted);
    if (!this.shown) return;
    const ageMs = this.shown.head.age_ms + now - this.shown.at;
    const isOld = isLive && now - this.shown.at > this.shown.head.valid_for_ms + SILENT_MS;
    this.stage.label(`input, ${seconds(ageMs)} old`, isDead ? "DEAD" : isOld ? "no new input" : "");
  }

  async show(wanted) {
    this.wanted = wanted;
    const bitmap = await createImageBitmap(wanted.coded);
    if (this.wanted === wanted) {
      this.stage.draw(bitmap);
      this.shown = wanted;
    }
    bitmap.close();
  }

  nearest(playing) {
    const fitting = this.past.filter((each) => each.head.epoch === playing.epoch && each.head.clock === playing.clock);
    const far = (each) => Math.abs(each.head.captured_s[0] - playing.captured_s);
    const best = fitting.reduce((a, b) => (a && far(a) <= far(b) ? a : b), null);
    return best && far(best) <= CLOSE_S ? best : undefined;
  }
}

// A generated view: plays each window once, at its rate, and holds its last frame until the next one comes.
export class ViewPicture {
  constructor() {
    this.stage = new Stage("view");
    this.reset("");
    this.maps = { cls: new ClassOverlay(), vis: new VisibilityOverlay(), depth: new DepthOverlay() };
    this.std = new DeviationOverlay();
    this.stage.box.addEventListener("pointermove", (event) => this.probe(event));
    this.stage.box.addEventListener("pointerdown", (event) => this.probe(event));
    this.stage.box.addEventListener("pointerleave", () => { element("probe").hidden = true; });
  }

  reset(view) {
    this.view = view;
    this.now = null; // the window on the screen
    this.next = null; // one that waits for its maps
    this.index = -1;
    this.last = null; // the last frame shown: {captured_s, epoch, boot_id}
    Object.values(this.maps ?? {}).forEach((each) => each.forget());
    this.std?.forget();
    element("played").style.width = "0";
    this.stage.clear("no view yet");
    element("view-note").textContent = "";
  }

  async take(head, bytes, at) {
    if (head.kind in this.maps) return this.maps[head.kind].take(head, await unpacked(bytes));
    if (head.kind === "std") return this.std.take(head, await unpacked(bytes));
    const bitmaps = await frames(head, bytes);
    if (head.view_id !== this.view) return bitmaps.forEach((each) => each.close());
    this.next?.bitmaps.forEach((each) => each.close());
    this.next = { head, bitmaps, at, decoded: performance.now() };
  }

  // Whether a view that may still be used is on the screen.
  isFresh(now) {
    return this.now !== null && now - this.now.at <= this.now.head.left_ms;
  }

  refresh(now, isDead) {
    const isWhole = this.next && Object.values(this.maps).every((each) => each.has(this.next.head));
    if (this.next && (isWhole || now - this.next.decoded > PATIENCE_MS)) this.begin(now);
    if (!this.now) return;
    const { head, at } = this.now;
    const played = this.first + Math.floor(((now - this.started) * head.fps) / 1000);
    const index = Math.min(head.frames - 1, Math.max(this.first, played));
    if (index !== this.index) this.draw(index);
    const behindMs = 1000 * (head.captured_s.at(-1) - this.last.captured_s); // this frame is older than the newest
    const ageMs = head.age_ms + now - at + behindMs;
    const over = isDead ? "DEAD" : this.isFresh(now) ? "" : "too old";
    this.stage.label(`generated, ${seconds(ageMs)} old`, over);
  }

  // Go on with the first frame that is newer than what was shown, if the window goes on with the same stream.
  begin(now) {
    this.now?.bitmaps.forEach((each) => each.close());
    [this.now, this.next] = [this.next, null];
    const { head } = this.now;
    const goesOn = this.last && this.last.epoch === head.epoch && this.last.boot_id === head.boot_id;
    const newer = goesOn ? head.captured_s.findIndex((each) => each > this.last.captured_s + 1e-4) : 0;
    this.first = Math.max(0, newer);
    this.started = now;
    this.index = -1;
    const size = `${head.width} × ${head.height}, ${head.fps.toFixed(0)} FPS`;
    element("view-facts").textContent = `${head.model.name}, ${size}, ${head.quality.steps} step${head.quality.steps === 1 ? "" : "s"}`;
    element("view").dataset.rev = head.rev;
    element("view").dataset.window = head.window_id;
    this.std.show(head);
  }

  draw(index) {
    const { head, bitmaps } = this.now;
    this.index = index;
    this.last = {
      captured_s: head.captured_s[Math.min(index, head.captured_s.length - 1)],
      epoch: head.epoch, boot_id: head.boot_id, clock: head.clock,
    };
    this.stage.draw(bitmaps[index]);
    Object.values(this.maps).forEach((each) => each.draw(head, index));
    element("played").style.width = `${(100 * (index + 1)) / head.frames}%`;
    const flags = head.quality.ood.length ? ` · outside training: ${head.quality.ood.join(", ")}` : "";
    element("view-note").textContent = `window ${head.window_id} · revision ${head.rev}${flags}`;
  }

  probe(event) {
    const { canvas, box } = this.stage;
    const place = canvas.getBoundingClientRect();
    const x = Math.floor(((event.clientX - place.left) / place.width) * canvas.width);
    const y = Math.floor(((event.clientY - place.top) / place.height) * canvas.height);
    const inside = x >= 0 && y >= 0 && x < canvas.width && y < canvas.height;
    const text = inside && this.now ? [...Object.values(this.maps), this.std].map((each) => each.at(x, y)).filter(Boolean).join(", ") : "";
    const probe = element("probe");
    probe.hidden = text === "";
    probe.textContent = text;
    const left = event.clientX - place.left;
    probe.style.left = `${Math.min(left + 12, box.clientWidth - probe.offsetWidth - 4)}px`;
    probe.style.top = `${Math.max(4, event.clientY - place.top - 28)}px`;
  }
}
