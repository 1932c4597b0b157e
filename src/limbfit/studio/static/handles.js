// A chart with vertical lines that can be dragged, or moved with the arrow keys.
import { Chart, pageColour } from "/web/chart.js";
import { el } from "/static/dom.js";

export class HandledChart extends Chart {
  /** content.handles: [{key, label, unit, value, low, high, step, colour, onmove(value), ondrop(value)}] */
  draw() {
    super.draw();
    this.lines = (this.content.handles ?? []).map((handle) => this.line(handle));
    this.chart.over.append(...this.lines.map((line) => line.element));
    this.arrange();
  }

  resize() {
    super.resize();
    this.arrange();
  }

  show(part) {
    super.show(part);
    this.arrange();
  }

  /** New curves with the handles where they are: what is dragged stays under the pointer. */
  renew(series) {
    this.content = { ...this.content, series };
    this.at = null;
    const { handles } = this.content;
    this.content.handles = [];
    super.draw();
    this.content.handles = handles;
    this.chart.over.append(...this.lines.map((line) => line.element));
    this.arrange();
  }

  arrange() {
    for (const { element, handle } of this.lines ?? []) {
      const at = this.chart.valToPos(handle.value, "x");
      element.style.left = `${at}px`;
      element.hidden = at < 0 || at > this.chart.over.clientWidth;
      element.setAttribute("aria-valuenow", String(handle.value));
      element.setAttribute("aria-valuetext", `${handle.value.toFixed(3)} ${handle.unit}`);
    }
  }

  line(handle) {
    const element = el("div", { class: "handle", role: "slider", tabindex: 0, "data-key": handle.key, "aria-label": handle.label,
      "aria-orientation": "horizontal", "aria-valuemin": handle.low, "aria-valuemax": handle.high }, el("span", {}, handle.label));
    element.style.color = pageColour(handle.colour, this.host);
    const move = (value) => {
      handle.value = Math.min(handle.high, Math.max(handle.low, value));
      this.arrange();
      handle.onmove(handle.value);
    };
    element.addEventListener("pointerdown", (event) => {
      event.stopPropagation();
      event.preventDefault();
      element.focus();
      const drag = (now) => move(this.chart.posToVal(now.clientX - this.chart.over.getBoundingClientRect().left, "x"));
      const drop = () => {
        removeEventListener("pointermove", drag);
        removeEventListener("pointerup", drop);
        handle.ondrop(handle.value);
      };
      addEventListener("pointermove", drag);
      addEventListener("pointerup", drop);
    });
    for (const kind of ["mousedown", "dblclick"]) element.addEventListener(kind, (event) => event.stopPropagation());
    element.addEventListener("keydown", (event) => {
      const way = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1 }[event.key];
      event.stopPropagation();
      if (!way) return;
      event.preventDefault();
      move(handle.value + way * handle.step * (event.shiftKey ? 10 : 1));
      clearTimeout(this.waiting);
      this.waiting = setTimeout(() => handle.ondrop(handle.value), 600);
    });
    return { element, handle };
  }
}
