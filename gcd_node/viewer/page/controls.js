// The virtual camera: sliders within what the model allows, sent to the control socket, and what came of it.

const element = (id) => document.getElementById(id);
const DIALS = { azimuth_deg: "°", elevation_deg: "°", radius: "", rate_deg_s: "°/s", amplitude_deg: "°" };
const POSE = ["azimuth_deg", "elevation_deg", "radius"];
const ORBIT = ["rate_deg_s", "amplitude_deg"];
const HANDS_OFF_MS = 1500; // a slider somebody was at follows the node again after so long
const SETTLE_MS = 150; // a slider that is being moved sends only where it rests

export class Controls {
  constructor(link) {
    this.link = link;
    this.view = null;
    this.views = {};
    this.camera = null; // of the model: "spherical", "none", or null while nobody knows
    this.touched = -Infinity;
    this.watched = null; // a revision we asked for and have not seen yet
    this.moved = null;
    for (const id of Object.keys(DIALS)) {
      element(id).addEventListener("input", () => { this.touched = performance.now(); this.show(id); });
      element(id).addEventListener("change", () => this.send());
    }
    element("motion").addEventListener("change", () => {
      this.touched = performance.now();
      this.showMotion();
      this.send();
    });
    element("pose").addEventListener("submit", (event) => event.preventDefault());
    element("sampling").addEventListener("submit", (event) => { event.preventDefault(); this.sample(); });
  }

  async refresh(commands) {
    this.commands = commands;
    if (!commands) return this.explain();
    const [described, views] = await Promise.all([this.link.ask("describe"), this.link.ask("views")]);
    if (described.ok) this.learn(described.result);
    if (views.ok) this.views = views.result;
    this.take();
    this.explain();
  }

  // What the model allows.
  learn(described) {
    this.camera = described.camera ?? null;
    this.model = described.model?.name ?? "";
    for (const id of POSE) {
      const allowed = described.limits?.[id];
      if (allowed) [element(id).min, element(id).max] = allowed;
    }
    if (described.limits?.azimuth_deg) element("amplitude_deg").max = described.limits.azimuth_deg[1];
  }

  select(view) {
    this.view = view;
    this.touched = -Infinity;
    this.watched = null;
    this.answer(true, "");
    this.take();
  }

  setRole(role) {
    this.role = role;
    element("sampling").hidden = role !== "operator" || !this.commands;
    if (role === "operator") this.takeSampling();
    this.explain();
  }

  explain() {
    const fixed = this.camera === "none";
    const why = this.commands === false ? "This node takes no commands: it has no [control] endpoint."
      : fixed ? `${this.model} draws one fixed view: it was trained for this camera alone and takes no angles.`
      : this.camera === null ? "What can be steered is known once the model is loaded."
      : this.role !== "operator" ? "You are looking. To steer, open the address with #token=… that the node printed."
      : "Differences from the source camera; the window in work still has the old ones.";
    element("steer-why").textContent = why;
    for (const control of element("pose").elements) control.disabled = fixed || this.camera === null || !this.commands;
  }

  // Put the node's values on the sliders, unless somebody is at them.
  take() {
    const now = this.views[this.view];
    if (!now) return;
    clearTimeout(this.later);
    const restMs = this.touched + HANDS_OFF_MS - performance.now();
    if (restMs > 0) {
      this.later = setTimeout(() => this.take(), restMs);
      return;
    }
    for (const id of [...POSE, ...ORBIT]) {
      if (now[id] !== null && now[id] !== undefined) element(id).value = now[id];
      this.show(id);
    }
    element("pose").elements.kind.value = now.kind;
    this.showMotion();
  }

  show(id) {
    const digits = id === "radius" ? 1 : 0;
    element(id).nextElementSibling.textContent = `${Number(element(id).value).toFixed(digits)}${DIALS[id]}`;
  }

  showMotion() {
    element("orbit").hidden = element("pose").elements.kind.value !== "orbit";
  }

  send() {
    this.touched = performance.now();
    clearTimeout(this.moved);
    this.moved = setTimeout(() => this.setView(), SETTLE_MS);
  }

  async setView() {
    const kind = element("pose").elements.kind.value;
    const wanted = kind === "orbit" ? [...POSE, ...ORBIT] : POSE;
    const args = { view: this.view, kind };
    for (const id of wanted) args[id] = Number(element(id).value);
    const reply = await this.link.ask("set_view", args);
    if (reply.ok) {
      this.watched = { rev: reply.result.view_rev, at: performance.now() };
      this.answer(true, `revision ${reply.result.view_rev} from the next window on`);
      return;
    }
    this.refuse(reply);
    this.touched = -Infinity;
    this.take(); // as the node has it
  }

  // A picture of this revision is on the screen.
  seen(rev) {
    if (!this.watched || rev < this.watched.rev) return;
    const waited = ((performance.now() - this.watched.at) / 1000).toFixed(1);
    this.answer(true, `revision ${this.watched.rev} is on the screen, ${waited} s after it was asked for`);
    this.watched = null;
  }

  async takeSampling() {
    const reply = await this.link.ask("get_config");
    if (!reply.ok) return;
    const { steps, guidance } = reply.result.config.model;
    for (const [id, value] of [["steps", steps], ["guidance_first", guidance?.[0]], ["guidance_last", guidance?.[1]]]) {
      element(id).value = value ?? "";
      element(id).placeholder = "trained";
    }
  }

  async sample() {
    const read = (id) => (element(id).value === "" ? null : Number(element(id).value));
    const guidance = [read("guidance_first"), read("guidance_last")];
    const args = {};
    if (read("steps") !== null) args.steps = read("steps");
    if (!guidance.includes(null)) args.guidance = guidance;
    else if (guidance.some((each) => each !== null)) return this.answer(false, "guidance needs the first and the last frame's scale");
    const reply = await this.link.ask("set_param", args);
    if (reply.ok) this.answer(true, `from the next window on: ${JSON.stringify(reply.result)}`);
    else this.refuse(reply);
  }

  refuse(reply) {
    const allowed = reply.result?.allowed ? ` Allowed: ${JSON.stringify(reply.result.allowed)}.` : "";
    this.answer(false, `${reply.code}: ${reply.message}.${allowed}`);
  }

  answer(good, text) {
    element("answer").dataset.good = String(good);
    element("answer").textContent = text;
  }
}
