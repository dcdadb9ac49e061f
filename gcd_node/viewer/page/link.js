// The connection to the node: opens it again when it breaks, and knows by this page's own clock whether anybody is there.

export const BEAT_LOST_MS = 1500; // the server speaks at least twice a second
export const NODE_SILENT_MS = 1800; // the node itself once a second
const AGAIN_MS = [250, 500, 1000, 2000, 3000];
const REPLY_MS = 4000;
const HEAD_BYTES = 8;

export class Link {
  // on: one function for each type of message, and `picture(head, bytes)`, `open()`.
  constructor(on) {
    this.on = on;
    this.began = performance.now();
    this.heard = null; // when anything came
    this.node = null; // {silentMs, at}: how long the node has been silent, and when we knew
    this.reason = "";
    this.attempts = 0;
    this.asked = new Map();
    this.lastId = 0;
    this.token = keepToken();
    this.open();
  }

  open() {
    this.socket = new WebSocket(`ws://${location.host}/feed`);
    this.socket.binaryType = "arraybuffer";
    this.socket.onopen = () => {
      this.say({ type: "hello", ...(this.token ? { token: this.token } : {}) });
      this.on.open();
    };
    this.socket.onmessage = (event) => this.hear(event.data);
    this.socket.onclose = (event) => this.lose(event);
  }

  hear(data) {
    this.heard = performance.now();
    this.attempts = 0;
    if (typeof data !== "string") {
      const said = new DataView(data);
      const size = said.getUint32(4, true);
      const head = read(JSON.parse(new TextDecoder().decode(new Uint8Array(data, HEAD_BYTES, size))), said.getFloat32(0, true));
      this.on.picture(head, new Uint8Array(data, HEAD_BYTES + size), this.heard);
      return;
    }
    const told = JSON.parse(data);
    if (told.type === "beat") {
      this.node = told.silent_ms === null ? null : { silentMs: told.silent_ms, at: this.heard };
    } else if (told.type === "reply") {
      this.settle(told);
    } else {
      if (told.type === "status" && this.node) this.node = { silentMs: 0, at: this.heard };
      this.on[told.type]?.(told);
    }
  }

  lose(event) {
    this.reason = event.reason || "";
    this.node = null;
    for (const id of [...this.asked.keys()]) this.settle({ id, ok: false, code: "NO_ANSWER", message: "the connection broke" });
    const wait = AGAIN_MS[Math.min(this.attempts++, AGAIN_MS.length - 1)];
    setTimeout(() => this.open(), wait);
  }

  say(what) {
    if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(what));
  }

  // A command; resolves with its reply, a refusal too.
  ask(verb, args = {}) {
    const id = ++this.lastId;
    return new Promise((resolve) => {
      const late = setTimeout(() => this.settle({ id, ok: false, code: "NO_ANSWER", message: "nobody answered" }), REPLY_MS);
      this.asked.set(id, { resolve, late });
      this.say({ type: "ask", id, verb, args });
    });
  }

  settle(reply) {
    const waiting = this.asked.get(reply.id);
    if (!waiting) return;
    this.asked.delete(reply.id);
    clearTimeout(waiting.late);
    waiting.resolve(reply);
  }

  // At this moment: whether there is a connection, and for how long the server and the node behind it have said nothing.
  silence(now) {
    return {
      isOpen: this.socket.readyState === WebSocket.OPEN,
      quietMs: now - (this.heard ?? this.began),
      silentMs: this.node && this.node.silentMs + (now - this.node.at),
    };
  }

  // "connecting", "alive" or "dead", and why, after such a silence.
  life({ isOpen, quietMs, silentMs }) {
    if (this.heard === null) {
      if (quietMs < BEAT_LOST_MS) return ["connecting", "waiting for the node"];
      return ["dead", this.reason || "nobody answers at this address"];
    }
    if (!isOpen) return ["dead", `${this.reason || "the connection is gone"}; last heard ${seconds(quietMs)} ago`];
    if (quietMs > BEAT_LOST_MS) return ["dead", `no sign of life for ${seconds(quietMs)}`];
    if (silentMs === null) return ["connecting", "the page is served, but the node has not spoken yet"];
    if (silentMs > NODE_SILENT_MS) return ["dead", `the node has been silent for ${seconds(silentMs)}: hung, or gone`];
    return ["alive", ""];
  }
}

// What the page needs of a picture: the protocol's header, and what the server says of it. Times of capture are seconds.
function read({ header, kind, offsets, age_ms, left_ms }, waitedMs) {
  const [frames, height, width] = header.shape;
  const { fps_cond: fps, epoch } = header.src;
  const captured_s = header.t_capture.map(([s, ns]) => s + ns / 1e9);
  const ages = { age_ms: age_ms + waitedMs, left_ms: left_ms - waitedMs };
  return { ...header, kind, offsets, ...ages, frames, height, width, fps, epoch, captured_s, rev: header.view_rev };
}

export function seconds(ms) {
  return ms < 9950 ? `${(ms / 1000).toFixed(1)} s` : ms < 90000 ? `${Math.round(ms / 1000)} s` : `${Math.round(ms / 60000)} min`;
}

// The token comes in the fragment, which no browser sends anywhere; it leaves the address bar at once.
function keepToken() {
  const given = new URLSearchParams(location.hash.slice(1)).get("token");
  if (given) {
    sessionStorage.setItem("gcd-token", given);
    history.replaceState(null, "", location.pathname);
  }
  return sessionStorage.getItem("gcd-token");
}
