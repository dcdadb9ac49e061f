// What the node says of itself: states, reasons, stages, events.

import { seconds } from "./link.js";

const LEVELS = ["OK", "WARN", "ERROR", "STALE"];
const MOST_EVENTS = 50;
const WORDS = {
  NODE_ERROR: "the node itself broke and is recovering",
  SRC_LOST: "the camera is gone",
  SRC_STALLED: "the camera is silent",
  SRC_CORRUPT: "many frames arrive damaged",
  SRC_FAILED: "reading frames broke",
  PUBLISH_FAILED: "sending views broke",
  INTERNAL: "the node itself broke",
  THREAD_DIED: "a part of the node has died: restart it",
  MODEL_FAILED: "the model was given up",
  MODEL_DEGRADED: "the model runs with less than was asked for",
  MODEL_HUNG: "a step of the model takes far too long",
  VIEWS_OVERDUE: "frames come, and no view does",
  IDLE: "nobody was looking, so nothing is rendered",
  NOT_ACTIVE: "the node is not active",
  SRC_NOT_STREAMING: "no frames come",
  MODEL_NOT_READY: "the model is not ready",
  VIEWS_NOT_FRESH: "no fresh view yet",
  fps: "a frame rate the model was not trained for",
  hfov: "a field of view the model was not trained for",
  view: "the camera is mounted otherwise than in training",
  world: "pictures unlike those the model was trained with",
  DEPTH_BAD: "the depth cannot be used, the model uses its own",
  ODOMETRY_BAD: "the odometry jumps, the model follows the pictures",
};
const element = (id) => document.getElementById(id);

export class HealthPanel {
  constructor() {
    this.forget();
  }

  forget() {
    this.status = null;
    this.numbers = new Set();
    element("events").replaceChildren();
    element("no-events").hidden = false;
  }

  // One line that says what keeps views from coming; empty if nothing does.
  summary() {
    if (!this.status) return "";
    const { state, model, reasons = [], not_ready: missing = [] } = this.status;
    if (["loading", "warming"].includes(model?.state)) return `the model is ${model.state === "loading" ? "being loaded" : "warming up"}`;
    if (state !== "active") return `the node is ${state}`;
    return [...reasons, ...missing].map((code) => WORDS[code] ?? code)[0] ?? "";
  }

  take(told) {
    const status = this.status = told.fields;
    element("node").textContent = told.node_id;
    element("brand").hidden = false;
    const level = status.level ?? 2;
    const reasons = [...(status.reasons ?? []), ...(status.not_ready ?? [])];
    element("reasons").replaceChildren(...(reasons.length ? reasons : ["OK"]).map((code) => {
      const item = document.createElement("li");
      item.dataset.level = reasons.length ? level : 0;
      item.textContent = code === "OK" ? "nothing to complain of" : WORDS[code] ? `${code}: ${WORDS[code]}` : code;
      return item;
    }));
    this.facts(status, level);
    this.stages(status.stages ?? {});
  }

  facts({ state, source = {}, window: windows = {}, model = {}, publish = {}, drops = {}, rec }, level) {
    const dropped = Object.entries(drops).filter(([, count]) => count > 0).map(([hop, count]) => `${hop} ${count}`);
    const rows = [
      ["state", `${state}, ${LEVELS[level]}`],
      ["source", [source.state, rate(source.fps), ago(source.last_frame_age_ms), count(source.reconnects, "reconnects"), count(source.corrupt, "damaged")]],
      ["windows", [`${windows.built ?? 0} built`, count(windows.rejected, "rejected"), count(windows.skipped, "skipped")]],
      ["model", [model.state, model.ms_p50 && `${Math.round(model.ms_p50)} ms a window`, model.gpu_mem_mb && `${Math.round(model.gpu_mem_mb)} MB`]],
      ["sent", [`${publish.sent ?? 0} messages`, bytes(publish.bytes), `${publish.subs ?? 0} subscriptions`]],
      ["given up", dropped.length ? dropped : ["nothing"]],
      ...(rec?.state ? [["recorder", [rec.state, rec.file, bytes(rec.bytes)]]] : []),
    ];
    element("facts").replaceChildren(...rows.flatMap(([name, told]) => {
      const term = document.createElement("dt");
      const what = document.createElement("dd");
      term.textContent = name;
      what.textContent = [told].flat().filter(Boolean).join(", ");
      return [term, what];
    }));
  }

  stages(stages) {
    element("stage-table").hidden = Object.keys(stages).length === 0;
    element("stage-table").tBodies[0].replaceChildren(...Object.entries(stages).map(([name, told]) => {
      const row = document.createElement("tr");
      for (const cell of [name.replace("_", " "), told.p50_ms, told.p99_ms, told.count]) row.insertCell().textContent = cell ?? "–";
      return row;
    }));
  }

  event(told) {
    if (this.numbers.has(told.number)) return; // told twice, to who has just come
    this.numbers.add(told.number);
    const { code, level, ...rest } = told.fields;
    const item = document.createElement("li");
    item.dataset.level = level ?? 2;
    const time = document.createElement("time");
    time.textContent = new Date(1000 * told.at_s).toLocaleTimeString([], { hour12: false });
    const name = document.createElement("b");
    name.textContent = code;
    const details = document.createElement("small");
    details.textContent = flat(rest).join(", ").slice(0, 240);
    item.append(time, name, details);
    element("events").prepend(item);
    while (element("events").children.length > MOST_EVENTS) element("events").lastChild.remove();
    element("no-events").hidden = true;
  }
}

// What an event tells, without what it leaves open: "view left", "azimuth_deg 41".
function flat(told) {
  return Object.entries(told).filter(([, value]) => value !== null).flatMap(([key, value]) => {
    if (Array.isArray(value)) return [`${key} ${value.join(" ")}`];
    return typeof value === "object" ? flat(value) : [`${key} ${value}`];
  });
}

const rate = (fps) => (fps === undefined ? "" : `${fps.toFixed(1)} FPS`);
const ago = (ms) => (ms === undefined ? "" : `a frame ${seconds(ms)} ago`);
const count = (value, words) => (value ? `${value} ${words}` : "");
const bytes = (value) => (value ? `${(value / 1e6).toFixed(value < 1e7 ? 1 : 0)} MB` : "");
