// Curves with units on both axes: values under the pointer or the arrow keys, enlarging by drag, all again by double click.
import { element } from "./overlay.js";
import { shortNumber } from "./colours.js";

const DASHES = { solid: [], dashed: [7, 4], dotted: [2, 3], dashdot: [8, 3, 2, 3] };
const KEY_LINES = { dashed: "dashed", dotted: "dotted", dashdot: "dashed" };

/** A colour of the page's style sheet by its name, for example --simulated; other words are colours already. */
export function pageColour(name, at = document.documentElement) {
  return name.startsWith("--") ? getComputedStyle(at).getPropertyValue(name).trim() || "#888" : name;
}

export class Chart {
  /**
   * host: an element; content: {label, x: {title, unit}, y: {title, unit, log}, series, band}
   * series: [{label, colour, dash, width, points, x, y}] with arrays of numbers, null where there is none;
   * band: {label, colour, x, low, high}.
   */
  constructor(host, content, height = 300) {
    this.host = host;
    this.height = height;
    host.classList.add("lf-chart");
    this.plot = element("div", { className: "lf-plot", tabIndex: 0, role: "application" });
    this.readout = element("p", { className: "lf-readout", ariaLive: "polite" });
    this.key = element("ul", { className: "lf-key" });
    host.append(this.key, this.plot, this.readout);
    this.plot.addEventListener("keydown", (event) => this.press(event));
    this.watcher = new ResizeObserver(() => this.resize());
    this.theme = matchMedia("(prefers-color-scheme: dark)");
    this.repaint = () => this.draw();
    this.theme.addEventListener("change", this.repaint);
    this.set(content);
    this.watcher.observe(host);
  }

  close() {
    this.watcher.disconnect();
    this.theme.removeEventListener("change", this.repaint);
    this.chart?.destroy();
    this.host.replaceChildren();
  }

  set(content) {
    this.content = content;
    this.at = this.zoom = null;
    this.readout.textContent = "";
    this.plot.setAttribute("aria-label",
      `${content.label} Left and right arrow keys read values, up and down change the curve.`);
    this.draw();
  }

  /** New curves of the same kind: what is enlarged and read stays. */
  move(content) {
    const same = content.series.length === this.content.series.length;
    this.content = content;
    if (same) this.chart.setData(this.data(), false);
    else this.draw();
    this.chart.redraw();
  }

  /** Longer curves of the same kind: the axes follow, but for what is enlarged; what is read stays. */
  grow(content) {
    const same = content.series.length === this.content.series.length;
    this.content = content;
    if (!same) return this.draw();
    this.measure();
    this.chart.setData(this.data(), false);
    this.rescale();
  }

  data() {
    return [null, ...this.content.series.map((one) => [one.x, one.y])];
  }

  resize() {
    const width = this.plot.clientWidth;
    if (this.chart && width && width !== this.chart.width) this.chart.setSize({ width, height: this.height });
  }

  draw() {
    this.chart?.destroy();
    const { series, x, y } = this.content;
    this.measure();
    const ink = pageColour("--muted", this.host), grid = pageColour("--grid", this.host);
    const axis = ({ title, unit }, more) => ({
      label: unit ? `${title} (${unit})` : title, stroke: ink, labelSize: 20, font: "12px system-ui, sans-serif",
      labelFont: "12px system-ui, sans-serif", grid: { stroke: grid, width: 1 }, ticks: { stroke: grid, width: 1 }, ...more,
    });
    const options = {
      mode: 2, width: Math.max(this.plot.clientWidth, 200), height: this.height, legend: { show: false },
      cursor: { drag: { x: true, y: true, uni: 20, setScale: false }, points: { show: false } },
      scales: { x: { time: false, range: () => this.zoom?.x ?? this.ends.x }, y: { distr: y.log ? 3 : 1, range: () => this.zoom?.y ?? this.ends.y } },
      axes: [axis(x, { size: 30 }), axis(y, { size: 56, values: (_, ticks) => ticks.map((tick) => tick === null ? "" : shortTick(tick, y.log ? 2 : 6)) })],
      series: [{}, ...series.map((one) => this.seriesOptions(one))],
      hooks: {
        drawAxes: [(plot) => this.drawBand(plot)], draw: [(plot) => this.drawMark(plot)],
        setCursor: [(plot) => this.follow(plot)], setSelect: [(plot) => this.enlarge(plot)],
      },
    };
    this.chart = new uPlot(options, this.data(), this.plot);
    this.chart.over.addEventListener("dblclick", () => this.show(null));
    this.drawKey();
  }

  /** Where the axes end so that all is seen. */
  measure() {
    const { series, band, y } = this.content;
    const bounds = (low, high) => [low - (0.03 * (high - low) || 0.5), high + (0.03 * (high - low) || 0.5)];
    const ends = (pick, extra) => {
      let low = Infinity, high = -Infinity;
      for (const values of [...series.map(pick), ...extra]) {
        for (const value of values) if (value !== null && value < Infinity) { low = Math.min(low, value); high = Math.max(high, value); }
      }
      return low <= high ? [low, high] : [0, 1];
    };
    const [low, high] = ends((one) => one.y, band ? [band.low, band.high] : []);
    this.ends = { x: bounds(...ends((one) => one.x, band ? [band.x] : [])), y: y.log ? [low / 1.2, high * 1.2] : bounds(low, high) };
  }

  enlarge(plot) {
    const { left, top, width, height } = plot.select;
    if (width < 5 || height < 5) return;
    plot.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
    this.show({
      x: [plot.posToVal(left, "x"), plot.posToVal(left + width, "x")],
      y: [plot.posToVal(top + height, "y"), plot.posToVal(top, "y")],
    });
  }

  /** A part of the plane {x: [low, high], y: [low, high]}, or all for null. */
  show(part) {
    this.zoom = part;
    this.rescale();
  }

  rescale() {
    const part = this.zoom ?? this.ends;
    this.chart.batch(() => { // at once: who asks for places next gets those of now
      for (const name of ["x", "y"]) this.chart.setScale(name, { min: part[name][0], max: part[name][1] });
    });
  }

  seriesOptions(one) {
    return {
      label: one.label, facets: [{ scale: "x", auto: true }, { scale: "y", auto: true }],
      paths: (plot, index) => drawPath(plot, index, pageColour(one.colour, this.host), one),
    };
  }

  drawBand(plot) {
    const { band } = this.content;
    if (!band) return;
    const { ctx } = plot;
    const x = (value) => plot.valToPos(value, "x", true), y = (value) => plot.valToPos(value, "y", true);
    ctx.save();
    clipToPlot(plot);
    ctx.beginPath();
    band.x.forEach((value, i) => ctx.lineTo(x(value), y(band.high[i])));
    for (let i = band.x.length - 1; i >= 0; i--) ctx.lineTo(x(band.x[i]), y(band.low[i]));
    ctx.globalAlpha = 0.22;
    ctx.fillStyle = pageColour(band.colour, this.host);
    ctx.fill();
    ctx.restore();
  }

  drawKey() {
    const { series, band } = this.content;
    const rows = series.map((one) => {
      const line = element("i", { className: "lf-key-line" });
      line.style.borderTop = `${Math.max(2, Math.min(one.width ?? 2, 3))}px ${KEY_LINES[one.dash] ?? "solid"} ${pageColour(one.colour, this.host)}`;
      return element("li", {}, line, one.label);
    });
    if (band) {
      const box = element("i", { className: "lf-key-band" });
      box.style.background = pageColour(band.colour, this.host);
      rows.push(element("li", {}, box, band.label));
    }
    this.key.replaceChildren(...rows);
  }

  /** The sample nearest to the pointer. */
  follow(plot) {
    const { left, top } = plot.cursor;
    if (left < 0 || top < 0) return;
    let best = null, least = 1600;
    this.content.series.forEach((one, s) => {
      for (let i = 0; i < one.x.length; i++) {
        if (one.y[i] === null || one.x[i] === null) continue;
        const far = (plot.valToPos(one.x[i], "x") - left) ** 2 + (plot.valToPos(one.y[i], "y") - top) ** 2;
        if (far < least) [best, least] = [{ s, i }, far];
      }
    });
    this.point(best);
  }

  point(at) {
    if (at?.s === this.at?.s && at?.i === this.at?.i) return;
    this.at = at;
    const { series, band, x, y } = this.content;
    let text = "";
    if (at) {
      const one = series[at.s];
      text = `${one.label}: ${x.title.toLowerCase()} ${shortNumber(one.x[at.i])} ${x.unit ?? ""}, ` +
        `${y.title.toLowerCase()} ${shortNumber(one.y[at.i])} ${y.unit ?? ""}`;
      const k = band ? band.x.indexOf(one.x[at.i]) : -1;
      if (k >= 0) text += ` (${band.label}: ${shortNumber(band.low[k])} to ${shortNumber(band.high[k])} ${y.unit ?? ""})`;
    }
    this.readout.textContent = text;
    this.chart.redraw(false);
  }

  drawMark(plot) {
    if (!this.at) return;
    const one = this.content.series[this.at.s];
    const { ctx } = plot, size = window.devicePixelRatio || 1;
    ctx.save();
    clipToPlot(plot);
    ctx.beginPath();
    ctx.arc(plot.valToPos(one.x[this.at.i], "x", true), plot.valToPos(one.y[this.at.i], "y", true), 5 * size, 0, 7);
    ctx.fillStyle = pageColour(one.colour, this.host);
    ctx.strokeStyle = pageColour("--page", this.host);
    ctx.lineWidth = 1.5 * size;
    ctx.fill();
    ctx.stroke();
    ctx.restore();
  }

  press(event) {
    const { series } = this.content;
    const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key], other = { ArrowDown: 1, ArrowUp: -1 }[event.key];
    if ((!step && !other) || !series.length) return;
    event.preventDefault();
    const now = this.at ?? { s: 0, i: -1 };
    const s = other ? (now.s + other + series.length) % series.length : now.s;
    const fast = event.shiftKey ? 10 : 1;
    const i = Math.max(0, Math.min(series[s].x.length - 1, now.i + (step ?? 0) * fast));
    this.point({ s, i });
  }
}

function shortTick(tick, digits) {
  return String(Number(tick.toPrecision(digits))).replace("-", "−");
}

function clipToPlot(plot) {
  const { left, top, width, height } = plot.bbox;
  plot.ctx.beginPath();
  plot.ctx.rect(left, top, width, height);
  plot.ctx.clip();
}

/** One curve as a line, or as dots where `points` is wanted; gaps where a value is null. */
function drawPath(plot, index, colour, one) {
  const { ctx } = plot, [xs, ys] = plot.data[index], size = window.devicePixelRatio || 1;
  ctx.save();
  clipToPlot(plot);
  ctx.beginPath();
  let open = false;
  for (let i = 0; i < xs.length; i++) {
    if (xs[i] === null || ys[i] === null) { open = false; continue; }
    const x = plot.valToPos(xs[i], "x", true), y = plot.valToPos(ys[i], "y", true);
    if (open) ctx.lineTo(x, y); else ctx.moveTo(x, y);
    open = true;
  }
  ctx.strokeStyle = ctx.fillStyle = colour;
  ctx.lineWidth = (one.width ?? 2) * size;
  ctx.setLineDash((DASHES[one.dash] ?? []).map((length) => length * size));
  ctx.stroke();
  if (one.points) {
    for (let i = 0; i < xs.length; i++) {
      if (xs[i] === null || ys[i] === null) continue;
      ctx.beginPath();
      ctx.arc(plot.valToPos(xs[i], "x", true), plot.valToPos(ys[i], "y", true), 3 * size, 0, 7);
      ctx.fill();
    }
  }
  ctx.restore();
  return null;
}
