// Puts the page together, and says in one word how things stand.

import { Controls } from "./controls.js";
import { HealthPanel } from "./health.js";
import { Link } from "./link.js";
import { InputPicture, ViewPicture } from "./pictures.js";

const TICK_MS = 100;
const element = (id) => document.getElementById(id);

const health = new HealthPanel();
const input = new InputPicture();
const view = new ViewPicture();
let bootId = null;
let steered = ""; // what the controls were last fitted to
let taking = Promise.resolve(); // pictures are taken in the order they came
let silence = null; // at the last look

const link = new Link({
  open: () => { steered = ""; if (view.view) link.say({ type: "watch", view: view.view }); },
  welcome: ({ commands }) => { health.forget(); controls.commands = commands; controls.explain(); },
  role: ({ role, refused }) => {
    element("role").textContent = refused ? "viewer: the token is not this node's" : role;
    element("role").dataset.role = role;
    controls.setRole(role);
  },
  status: (told) => {
    noticeBoot(told.boot_id);
    health.take(told);
    fitControls();
  },
  meta: (told) => { noticeBoot(told.boot_id); offerViews(told.fields.views ?? []); },
  event: (told) => {
    health.event(told);
    if (["VIEW_SET", "VIEW_ALIGNED", "VIEW_REMOVED", "PARAM_SET"].includes(told.fields.code)) controls.refresh(controls.commands);
  },
  picture: (head, bytes, at) => {
    taking = taking.then(() => take(head, bytes, at)).catch((error) => console.warn("a picture could not be shown", error))
      .finally(() => link.say({ type: "got" }));
  },
});
const controls = new Controls(link);

async function take(head, bytes, at) {
  if (head.kind === "src") return input.take(head, bytes, at);
  if (head.view_id !== view.view) return;
  await view.take(head, bytes, at);
}

// The node was started anew: what was tied to the old one is forgotten.
function noticeBoot(id) {
  if (bootId !== null && bootId !== id) {
    steered = "";
    view.reset(view.view);
    link.say({ type: "watch", view: view.view });
  }
  bootId = id;
}

// Ask again what can be steered when the model or the state has changed.
function fitControls() {
  const { state, model } = health.status;
  const now = `${bootId} ${state} ${["absent", "loading"].includes(model?.state)}`;
  if (now === steered) return;
  steered = now;
  controls.refresh(controls.commands).then(() => controls.setRole(element("role").dataset.role));
}

function offerViews(ids) {
  const choice = element("views");
  choice.hidden = ids.length < 2;
  const kept = localStorage.getItem("gcd-view");
  const selected = ids.includes(view.view) ? view.view : ids.includes(kept) ? kept : ids[0];
  choice.replaceChildren(choice.querySelector("legend"), ...ids.map((id) => option(id, id === selected)));
  if (selected !== undefined && selected !== view.view) select(selected);
}

function option(id, isSelected) {
  const label = document.createElement("label");
  const radio = document.createElement("input");
  const text = document.createElement("span");
  Object.assign(radio, { type: "radio", name: "view", value: id, checked: isSelected });
  radio.addEventListener("change", () => { localStorage.setItem("gcd-view", id); select(id); });
  text.textContent = id;
  label.append(radio, text);
  return label;
}

function select(id) {
  view.reset(id);
  controls.select(id);
  link.say({ type: "watch", view: id });
}

// The one word: connecting, live, stale, dead. For whoever measures: since when, by this page's clock, and after which
// silence; and which it was when the page looked before.
function turn(now) {
  const before = silence;
  silence = link.silence(now);
  const [life, why] = link.life(silence);
  const isFresh = view.isFresh(now);
  const state = life !== "alive" ? life : isFresh ? "live" : "stale";
  const reason = why || health.summary() || (state === "live" ? "" : view.now ? "the last view is too old, and no newer one has come" : "no view has come yet");
  const { dataset } = document.body;
  if (dataset.state !== state) {
    dataset.state = state;
    dataset.since = String(now);
    dataset.silence = JSON.stringify([before, silence]);
    element("state").textContent = state;
    document.title = `${state === "live" ? "" : `${state}: `}${health.status ? element("node").textContent : "gcd-node"}`;
  }
  if (element("why").textContent !== reason) element("why").textContent = reason;
}

function paint() {
  const now = performance.now();
  const isDead = document.body.dataset.state === "dead";
  view.refresh(now, isDead);
  if (view.now && !isDead) controls.seen(view.now.head.rev);
  input.refresh(now, view.last, isDead);
  requestAnimationFrame(paint);
}

setInterval(() => turn(performance.now()), TICK_MS);
requestAnimationFrame(paint);
