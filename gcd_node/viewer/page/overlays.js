// What can be laid over a view: its class map, what of it is painted, its depth, and where samples of the model differ.

const element = (id) => document.getElementById(id);

export function sized(canvas, width, height) {
  if (canvas.width !== width || canvas.height !== height) {
    canvas.width = width;
    canvas.height = height;
  }
  return canvas.getContext("2d");
}

// One byte for each pixel of the window on the screen; `palette` says how each looks.
class MapOverlay {
  constructor(name, legend) {
    this.name = name;
    this.canvas = element(`${name}-picture`);
    this.palette = new Uint32Array(256);
    this.forget();
    slider(name, this.canvas, legend, () => this.redraw());
  }

  forget() {
    this.maps = new Map(); // by window id; the newest two
    this.drawn = null;
    element(`${this.name}-tool`).hidden = true; // and with it its legend
    this.canvas.getContext("2d").clearRect(0, 0, this.canvas.width, this.canvas.height);
  }

  take(head, numbers) {
    this.maps.set(head.window_id, { head, numbers });
    for (const id of [...this.maps.keys()].slice(0, -2)) this.maps.delete(id);
    element(`${this.name}-tool`).hidden = false;
  }

  // Whether nothing is left to wait for before this window is shown.
  has(view) {
    return this.maps.size === 0 || this.find(view) !== undefined;
  }

  find(view) {
    const map = this.maps.get(view.window_id);
    return map && map.head.rev === view.rev && map.head.boot_id === view.boot_id ? map : undefined;
  }

  draw(view, index) {
    const map = this.find(view);
    this.drawn = map ? { map, index } : null;
    const context = sized(this.canvas, view.width, view.height);
    if (!map) return context.clearRect(0, 0, view.width, view.height);
    if (this.canvas.style.opacity === "0") return;
    const size = view.width * view.height;
    const picture = context.createImageData(view.width, view.height);
    const pixels = new Uint32Array(picture.data.buffer);
    this.fill(pixels, map.numbers.subarray(index * size, (index + 1) * size), view.width);
    context.putImageData(picture, 0, 0);
  }

  fill(pixels, numbers) {
    for (let i = 0; i < pixels.length; i++) pixels[i] = this.palette[numbers[i]];
  }

  redraw() {
    if (this.drawn) this.draw(this.drawn.map.head, this.drawn.index);
  }

  at(x, y) {
    if (!this.drawn) return "";
    const { map, index } = this.drawn;
    const { width, height } = map.head;
    return this.text(map.numbers[index * width * height + y * width + x], map.head);
  }

  // What a number means.
  text(number, head) {
    return head.classes.find((each) => each.id === number)?.name.replaceAll("_", " ") ?? `class ${number}`;
  }
}

// What was never seen is painted: thin amber diagonals over it, as `gcd-node view --hatch` draws them.
export class VisibilityOverlay extends MapOverlay {
  constructor() {
    super("vis", element("vis-legend"));
  }

  fill(pixels, numbers, width) {
    for (let i = 0; i < pixels.length; i++) {
      const line = ((i % width) + Math.floor(i / width)) % 6 < 2;
      pixels[i] = line && numbers[i] === 0 ? rgba(245, 158, 11) : 0;
    }
  }
}

// Brighter is nearer: a level is 255 v / (v + 0.1) of an inverse depth of v 1/m.
export class DepthOverlay extends MapOverlay {
  constructor() {
    super("depth", element("depth-legend"));
    this.palette = this.palette.map((_, level) => rgba(level, level, level));
  }

  text(level) {
    return level === 0 ? "no depth" : `${((10 * (255 - level)) / level).toFixed(1)} m`;
  }
}

// The class map, in the colours of its ontology.
export class ClassOverlay extends MapOverlay {
  constructor() {
    super("class", element("legend"));
    this.hidden = new Set();
  }

  forget() {
    super.forget();
    this.names = "";
  }

  take(head, numbers) {
    super.take(head, numbers);
    const names = JSON.stringify(head.classes);
    if (names !== this.names) this.legend(head.classes, names);
  }

  legend(classes, names) {
    this.names = names;
    this.colour(classes);
    element("legend").replaceChildren(...classes.map((each) => {
      const button = document.createElement("button");
      button.type = "button";
      button.setAttribute("aria-pressed", String(!this.hidden.has(each.id)));
      button.append(swatch(`rgb(${each.colour.join(" ")})`), each.name.replaceAll("_", " "));
      button.addEventListener("click", () => {
        this.hidden.delete(each.id) || this.hidden.add(each.id);
        button.setAttribute("aria-pressed", String(!this.hidden.has(each.id)));
        this.colour(classes);
        this.redraw();
      });
      const item = document.createElement("li");
      item.append(button);
      return item;
    }));
  }

  colour(classes) {
    this.palette = new Uint32Array(256);
    for (const { id, colour: [red, green, blue] } of classes) {
      if (!this.hidden.has(id)) this.palette[id] = rgba(red, green, blue);
    }
  }
}

// Where several samples of the model differ.
export class DeviationOverlay {
  constructor() {
    this.canvas = element("std-picture");
    this.forget();
    slider("std", this.canvas, element("std-legend"), () => {});
  }

  forget() {
    this.map = null;
    element("std-tool").hidden = element("std-legend").hidden = true;
    this.canvas.getContext("2d").clearRect(0, 0, this.canvas.width, this.canvas.height);
  }

  take(head, levels) {
    this.map = { head, levels };
    element("std-tool").hidden = false;
    const top = (255 * head.scale).toFixed(1);
    element("std-legend").textContent = `Brightest where samples differ most: a standard deviation of ${top} grey levels.`;
    const context = sized(this.canvas, head.width, head.height);
    const size = head.width * head.height;
    const picture = context.createImageData(head.width, head.height);
    const from = (head.frames - 1) * size; // of several frames, the newest
    for (let i = 0; i < size; i++) picture.data.set([255, 45, 150, levels[from + i]], 4 * i);
    context.putImageData(picture, 0, 0);
  }

  show(view) {
    const old = this.map && this.map.head.boot_id !== view.boot_id;
    if (old) this.forget();
  }

  at(x, y) {
    if (!this.map) return "";
    const { head, levels } = this.map;
    if (x >= head.width || y >= head.height) return "";
    return `± ${(levels[(head.frames - 1) * head.width * head.height + y * head.width + x] * head.scale).toFixed(1)}`;
  }
}

function rgba(red, green, blue) {
  return ((255 << 24) | (blue << 16) | (green << 8) | red) >>> 0;
}

export function swatch(colour) {
  const svg = document.createElementNS("http://www.w3.org/2000/svg", "svg");
  svg.setAttribute("viewBox", "0 0 1 1");
  svg.setAttribute("aria-hidden", "true");
  const square = document.createElementNS("http://www.w3.org/2000/svg", "rect");
  square.setAttribute("width", "1");
  square.setAttribute("height", "1");
  square.setAttribute("fill", colour);
  svg.append(square);
  return svg;
}

// An overlay's opacity; its legend is there while it can be seen.
function slider(name, canvas, legend, changed) {
  const input = element(`${name}-opacity`);
  const tool = element(`${name}-tool`);
  input.value = localStorage.getItem(`gcd-${name}-opacity`) ?? input.value;
  const apply = () => {
    canvas.style.opacity = String(input.value / 100);
    input.nextElementSibling.textContent = `${input.value} %`;
    legend.hidden = input.value === "0" || tool.hidden;
    changed();
  };
  input.addEventListener("input", () => {
    localStorage.setItem(`gcd-${name}-opacity`, input.value);
    apply();
  });
  new MutationObserver(apply).observe(tool, { attributes: true, attributeFilter: ["hidden"] });
  apply();
}
