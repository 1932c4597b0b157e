// The trimline in the view Socket: handles along the brim, dragged up and down the limb, or moved with the arrow keys.
import { el, replace } from "/static/dom.js";

const SVG = "http://www.w3.org/2000/svg", STEP_MM = 1, SLOWLY_MS = 600, BEHIND = 0.15;
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

export class TrimHandles {
  /** view: has context, viewer (or none), frame; sent(path, values, text) writes a change and shows the new shape. */
  constructor(view, sent) {
    Object.assign(this, { view, sent, stored: [], points: [], handles: [], held: null, up: [0, 0, 1] });
    this.line = document.createElementNS(SVG, "polyline");
    const picture = document.createElementNS(SVG, "svg");
    picture.append(this.line);
    this.over = el("div", { class: "trim-handles", role: "group", "aria-label": "Trimline" }, picture);
    this.words = el("p", { class: "hint" });
    this.away = el("button", { type: "button", onclick: () => this.sent("socket/trimline/remove", {}, "The brim is the default one.") }, "Default brim");
    this.part = el("div", {}, el("h2", {}, "Trimline"), this.words, el("div", { class: "row" }, this.away));
    const { viewer } = view;
    if (!viewer) return;
    viewer.overlay.host.before(this.over); // names stay readable
    const { changed } = viewer.view;
    viewer.view.changed = () => {
      changed();
      this.arrange();
    };
  }

  /** The brim of a shape of the server; what is being dragged stays under the pointer. */
  take({ file, trim }) {
    const { viewer, frame } = this.view, known = JSON.stringify([file, trim, frame]);
    if (known === this.known) return;
    this.known = known;
    const held = this.handles.length === trim.points.length && this.held !== null ? this.points[this.held] : null;
    Object.assign(this, { stored: trim.points, points: trim.points.map((point) => [...point]), up: frame[2] });
    if (held) this.points[this.held] = held;
    this.part.hidden = Boolean(file);
    this.away.disabled = !trim.is_line;
    this.words.textContent = !this.points.length ? "There is no brim to drag."
      : !viewer ? "This browser does not draw the brim."
        : `${trim.is_line ? "A line of the study" : "A plane"}. Drag its handles up or down the limb, or move them with the arrow keys (1 mm; Shift: 10 mm).`;
    if (!viewer) return;
    if (this.handles.length !== this.points.length) {
      this.handles = this.points.map((_, i) => this.handle(i));
      replace(this.over, this.line.parentNode, ...this.handles);
    }
    this.arrange();
  }

  /** Out of the way while an area is placed. */
  aside(away) {
    this.over.classList.toggle("aside", away);
  }

  clear() {
    Object.assign(this, { known: null, held: null, stored: [], points: [], handles: [] });
    replace(this.over, this.line.parentNode);
    this.arrange();
  }

  /** Put the handles where the brim is seen now; those behind the limb are out of reach. */
  arrange() {
    const { viewer } = this.view, { direction } = viewer.view.axes();
    const box = viewer.canvas.getBoundingClientRect(), middle = [0, 1, 2].map((k) => this.mean(k));
    const places = this.points.map((point) => viewer.pixelOf(point).map((value, k) => value - (k ? box.top : box.left)));
    const hidden = this.points.map((point) => {
      const from = point.map((value, k) => value - middle[k]), along = dot(from, this.up);
      const flat = from.map((value, k) => value - along * this.up[k]);
      return dot(flat, direction) > BEHIND * Math.hypot(...flat);
    });
    this.handles.forEach((handle, i) => {
      const [x, y] = places[i], height = dot(this.points[i], this.up);
      handle.style.transform = `translate(${x}px, ${y}px)`;
      handle.hidden = hidden[i];
      handle.setAttribute("aria-valuenow", height.toFixed(1));
      handle.setAttribute("aria-valuetext", `${height.toFixed(1)} mm along the limb`);
    });
    const from = hidden.findIndex((one, i) => !one && hidden.at(i - 1)); // where what is seen begins
    const order = this.points.map((_, i) => (i + Math.max(from, 0)) % this.points.length).filter((i) => !hidden[i]);
    if (from < 0 && order.length) order.push(order[0]);
    this.line.setAttribute("points", order.map((i) => places[i].join(",")).join(" "));
  }

  mean(k) {
    return this.points.reduce((sum, point) => sum + point[k], 0) / Math.max(this.points.length, 1);
  }

  handle(i) {
    const handle = el("div", { class: "trim-handle", role: "slider", tabindex: 0, "aria-orientation": "vertical",
      "aria-label": `trimline ${i + 1} of ${this.points.length}`, title: "drag up or down the limb" });
    const move = (millimetres) => {
      this.points[i] = this.points[i].map((value, k) => value + millimetres * this.up[k]);
      this.arrange();
    };
    handle.addEventListener("pointerdown", (event) => {
      if (event.button) return;
      event.preventDefault();
      event.stopPropagation();
      handle.focus();
      handle.setPointerCapture(event.pointerId);
      this.held = i;
      let last = [event.clientX, event.clientY];
      const drag = (now) => {
        const [here, there] = [0, 1].map((far) => this.view.viewer.pixelOf(this.points[i].map((value, k) => value + far * this.up[k])));
        const way = [there[0] - here[0], there[1] - here[1]], size = way[0] ** 2 + way[1] ** 2; // pixels of 1 mm
        if (size > 0.01) move(((now.clientX - last[0]) * way[0] + (now.clientY - last[1]) * way[1]) / size);
        last = [now.clientX, now.clientY];
      };
      const drop = () => {
        handle.removeEventListener("pointermove", drag);
        for (const name of ["pointerup", "pointercancel"]) handle.removeEventListener(name, drop);
        this.save();
      };
      handle.addEventListener("pointermove", drag);
      for (const name of ["pointerup", "pointercancel"]) handle.addEventListener(name, drop);
    });
    handle.addEventListener("keydown", (event) => {
      const way = { ArrowUp: 1, ArrowRight: 1, ArrowDown: -1, ArrowLeft: -1 }[event.key];
      if (!way) return;
      event.preventDefault();
      this.held = i;
      move(way * STEP_MM * (event.shiftKey ? 10 : 1));
      clearTimeout(this.waiting);
      this.waiting = setTimeout(() => this.save(), SLOWLY_MS);
    });
    return handle;
  }

  /** Write the line as it is now; back to the stored one where that is refused. */
  async save() {
    this.held = null;
    if (JSON.stringify(this.points) === JSON.stringify(this.stored)) return;
    if (await this.sent("socket/trimline", { points: this.points }, "The trimline is in the study.")) return;
    this.points = this.stored.map((point) => [...point]);
    this.arrange();
  }
}
