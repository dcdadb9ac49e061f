// Two small plots on canvas: where the age of each window comes from, and how long each stage takes.

import { swatch } from "./overlays.js";

const SPANS_S = [60, 120, 300];
const KEPT = 900;
const LEFT = 52, BOTTOM = 18, TOP = 6, RIGHT = 4;
const PARTS = [["waited_ms", "--wait", "waiting for the model"], ["model_ms", "--model", "model"], ["after_ms", "--send", "leaving"]];
const STAGES = ["capture_gap", "window", "encode", "render", "publish", "age"];
const element = (id) => document.getElementById(id);
const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

export class Plots {
  constructor() {
    this.forget();
  }

  forget() {
    this.windows = [];
    this.samples = [];
    this.offsetS = null; // the node's clock minus ours
  }

  // Windows: {view, at_s, age_ms, waited_ms, model_ms, after_ms}. Samples: {at_s, stages: {name: ms}}.
  addWindows(windows) {
    const known = new Set(this.windows.map((each) => `${each.view} ${each.at_s}`)); // who has just come is told some twice
    const unknown = windows.filter((each) => !known.has(`${each.view} ${each.at_s}`));
    this.windows = [...this.windows, ...unknown].sort((a, b) => a.at_s - b.at_s).slice(-KEPT);
  }

  addSamples(samples, isNow) {
    this.samples = [...this.samples, ...samples].slice(-KEPT);
    if (isNow) this.offsetS = samples.at(-1).at_s - Date.now() / 1000;
  }

  draw(view) {
    const nowS = Date.now() / 1000 + (this.offsetS ?? 0);
    const oldestS = nowS - Math.min(nowS, ...[...this.windows, ...this.samples].map((each) => each.at_s));
    const span = SPANS_S.find((each) => oldestS <= each) ?? SPANS_S.at(-1);
    const recent = (each) => nowS - each.at_s < span;
    this.drawAges(this.windows.filter((each) => each.view === view && recent(each)), { nowS, span });
    this.drawStages(this.samples.filter(recent), { nowS, span });
  }

  drawAges(windows, when) {
    const plane = new Plane(element("ages"), when, Math.max(...windows.map((each) => each.age_ms), 0));
    for (const [i, each] of windows.entries()) {
      const gap = i + 1 < windows.length ? windows[i + 1].at_s - each.at_s : 1;
      const width = Math.max(1.5, Math.min(0.8 * plane.perS * gap, 9));
      let bottom = 0;
      for (const [name, shade] of PARTS) {
        plane.bar(each.at_s, width, bottom, bottom + each[name], colour(shade));
        bottom += each[name];
      }
    }
    const last = windows.at(-1);
    key("ages-key", PARTS.map(([name, shade, words]) => [words, colour(shade), last?.[name]]), last ? ["age", last.age_ms] : null);
  }

  drawStages(samples, when) {
    const names = STAGES.filter((name) => samples.some((each) => name in each.stages));
    const values = samples.flatMap((each) => Object.values(each.stages)).filter((each) => each > 0);
    const plane = new Plane(element("stages"), when, Math.max(...values, 10), Math.min(...values, 10));
    const shade = (name) => colour(`--s${STAGES.indexOf(name)}`);
    for (const name of names) {
      plane.line(samples.filter((each) => name in each.stages).map((each) => [each.at_s, each.stages[name]]), shade(name));
    }
    key("stages-key", names.map((name) => [name.replace("_", " "), shade(name), samples.at(-1)?.stages[name]]), null);
  }
}

// A canvas with time from left to right and milliseconds upwards.
class Plane {
  // {nowS, span}, seconds. lowest: given, the scale is logarithmic.
  constructor(canvas, { nowS, span }, highest, lowest = null) {
    const scale = window.devicePixelRatio || 1;
    const { clientWidth: width, clientHeight: height } = canvas;
    if (canvas.width !== Math.round(width * scale) || canvas.height !== Math.round(height * scale)) {
      canvas.width = Math.round(width * scale);
      canvas.height = Math.round(height * scale);
    }
    this.context = canvas.getContext("2d");
    this.context.setTransform(scale, 0, 0, scale, 0, 0);
    this.context.clearRect(0, 0, width, height);
    Object.assign(this, { width, height, nowS, span });
    this.perS = (width - LEFT - RIGHT) / span;
    [this.top, this.bottom] = lowest === null ? [nice(highest), null] : [power(highest, Math.ceil), power(lowest, Math.floor)];
    this.axes();
  }

  x(atS) {
    return this.width - RIGHT - (this.nowS - atS) * this.perS;
  }

  y(ms) {
    const part = this.bottom === null ? ms / this.top
      : Math.log(Math.max(ms, this.bottom) / this.bottom) / Math.log(this.top / this.bottom);
    return this.height - BOTTOM - part * (this.height - BOTTOM - TOP);
  }

  ticks() {
    if (this.bottom === null) return [0, this.top / 2, this.top];
    const powers = Math.round(Math.log10(this.top / this.bottom));
    return Array.from({ length: powers + 1 }, (_, i) => this.bottom * 10 ** i);
  }

  axes() {
    const { context } = this;
    context.font = "11px ui-sans-serif, system-ui, sans-serif";
    context.strokeStyle = colour("--line");
    context.fillStyle = colour("--soft");
    context.lineWidth = 1;
    context.textBaseline = "middle";
    context.textAlign = "right";
    for (const ms of this.ticks()) {
      const y = Math.round(this.y(ms)) + 0.5;
      context.beginPath();
      context.moveTo(LEFT, y);
      context.lineTo(this.width - RIGHT, y);
      context.stroke();
      context.fillText(time(ms), LEFT - 6, y);
    }
    context.textBaseline = "bottom";
    const parts = this.width < 420 ? 1 : this.span / 60 > 2 ? 5 : 4;
    for (let part = 0; part <= parts; part++) {
      const agoS = (this.span * part) / parts;
      const text = part === 0 ? "now" : agoS < 60 ? `${agoS} s ago` : `${agoS / 60} min ago`;
      context.textAlign = part === 0 ? "right" : part === parts ? "left" : "center";
      context.fillText(text, this.x(this.nowS - agoS), this.height);
    }
  }

  bar(atS, width, fromMs, toMs, shade) {
    this.context.fillStyle = shade;
    this.context.fillRect(Math.max(LEFT, this.x(atS) - width), this.y(toMs), width, this.y(fromMs) - this.y(toMs));
  }

  line(points, shade) {
    const { context } = this;
    context.strokeStyle = shade;
    context.lineWidth = 1.6;
    context.beginPath();
    let before = null;
    for (const [atS, ms] of points) {
      const draw = before !== null && atS - before < 5 ? "lineTo" : "moveTo"; // a hole in time stays one
      context[draw](Math.max(LEFT, this.x(atS)), this.y(ms));
      before = atS;
    }
    context.stroke();
  }
}

// 1, 2 or 5 times a power of ten, at least as large.
function nice(value) {
  if (!(value > 0)) return 1;
  const power = 10 ** Math.floor(Math.log10(value));
  return [1, 2, 5, 10].map((each) => each * power).find((each) => each >= value);
}

function time(ms) {
  if (ms === 0) return "0";
  return ms < 1000 ? `${Number(ms.toPrecision(ms < 10 ? 1 : 3))} ms` : `${Number((ms / 1000).toPrecision(3))} s`;
}

const power = (value, round) => 10 ** round(Math.log10(value));

function key(id, rows, total) {
  const items = rows.map(([words, shade, ms]) => {
    const item = document.createElement("li");
    item.append(swatch(shade), `${words} `, number(ms));
    return item;
  });
  if (total) {
    const item = document.createElement("li");
    item.append(`${total[0]} `, number(total[1]));
    items.push(item);
  }
  element(id).replaceChildren(...items);
}

function number(ms) {
  const bold = document.createElement("b");
  bold.textContent = ms === undefined ? "–" : time(ms);
  return bold;
}
