// A field of one site on the deformed, cut mesh, played through time.
import { el, replace } from "/static/dom.js";
import { readArrays } from "/web/arrays.js";
import { shortNumber } from "/web/colours.js";
import { nodalMeans } from "/web/volume.js";
import { canDraw, Viewer } from "/web/viewer.js";
import { cutPanel, FITTED, HELD_OUT, labelled, loadMesh, NO_WEBGL, REGION_COLOURS, runButton } from "/static/views/parts.js";

const FALLBACK = "von_mises", AT_ONCE = 3;

export class Player {
  /** moment(time) is told of every moment shown, in s. */
  constructor(context, moment) {
    Object.assign(this, { context, moment, frames: [], times: [], at: 0, playing: null, turn: 0, mesh: null });
    this.run = runButton(context, "predict");
    this.stage = el("div", { class: "player-stage" });
    this.drawing = canDraw();
    if (this.drawing) this.viewer = new Viewer(this.stage, "A field on the deformed, cut mesh of a site.");
    else this.stage.append(el("p", { class: "padded failed" }, NO_WEBGL));
    this.build();
  }

  build() {
    this.source = el("select", { onchange: () => { this.wanted = this.source.value; this.load(); } });
    this.field = el("select", { onchange: () => this.load(() => this.readFrames()) });
    this.map = el("select", { onchange: () => this.scale() }, ...["viridis", "cividis"].map((name) => el("option", { value: name }, name)));
    this.smooth = el("input", { type: "checkbox", checked: true, onchange: () => this.show(this.at) });
    this.edges = el("input", { type: "checkbox", onchange: () => this.style() });
    this.warp = el("input", { type: "range", min: "0", max: "3", step: "0.1", value: "1", oninput: () => this.style() });
    this.warpText = el("output", { class: "hint" });
    this.limits = ["lowest colour", "highest colour"].map((text) => el("input", { type: "number", step: "any", class: "limit", placeholder: "auto", "aria-label": text, onchange: () => this.scale() }));
    this.cut = cutPanel((plane) => this.viewer?.cutMesh(plane), (normal) => this.viewer?.view.lookAlong(normal.map((value) => -value)), { whole: false });
    this.settings = el("div", {}, el("h2", {}, "Field"), labelled("stored", this.source), labelled("show", this.field), labelled("colours", this.map),
      el("div", { class: "field" }, "range", el("span", {}, ...this.limits)),
      el("label", { class: "field" }, "deformation", this.warpText, this.warp),
      el("label", { class: "row" }, this.smooth, "smooth (means at the nodes)"),
      el("label", { class: "row" }, this.edges, "edges of cells"), this.cut.part);
    this.button = el("button", { type: "button", class: "main", "aria-label": "Play", onclick: () => this.toggle() }, "▶ Play");
    this.slider = el("input", { type: "range", min: "0", max: "0", step: "1", value: "0", "aria-label": "moment", oninput: () => { this.stop(); this.show(Number(this.slider.value)); } });
    this.speed = el("select", { "aria-label": "speed" }, ...[["0.5", "half speed"], ["1", "real time"], ["4", "4 times"]].map(([value, text]) => el("option", { value }, text)));
    this.speed.value = "1";
    this.words = el("output", { class: "player-words" });
    this.bar = el("div", { class: "player-bar" }, this.button, this.slider, this.speed,
      el("button", { type: "button", onclick: () => this.look() }, "Reset view"), this.words);
  }

  /** Show a site: {name, position_mm, axis}, its sources, and the patient's sides. */
  async open(site, sources, frame) {
    Object.assign(this, { site, sources, frame });
    replace(this.source, ...sources.map((one) => el("option", { value: one.source }, one.title)));
    if (sources.some((one) => one.source === this.wanted)) this.source.value = this.wanted;
    await this.load();
  }

  load(read = () => this.read()) {
    const what = [`the fields of site ${this.site.name}`, this.source.selectedOptions[0]?.text].filter(Boolean).join(", ");
    return this.context.load(this.stage, what, read);
  }

  async read() {
    this.stop();
    const chosen = this.sources.find((one) => one.source === this.source.value);
    this.turn++;
    this.viewer?.setMesh(null);
    this.viewer?.setColours(null);
    Object.assign(this, { mesh: null, frames: [], times: chosen?.times_s ?? [], at: 0 });
    const playable = this.times.length > 1;
    for (const part of [this.button, this.slider, this.speed]) part.disabled = !playable;
    this.slider.max = String(Math.max(0, this.times.length - 1));
    this.words.textContent = "";
    this.settings.hidden = !chosen;
    if (!chosen && this.site.records?.length === 0)
      return { text: "This site has no record, so nothing is predicted here. Simulate every step to see what the model does." };
    if (!chosen) return { text: "No fields are stored for this site.", actions: [this.run] };
    const { mesh, facts } = await loadMesh(this.context, `results/mesh/${chosen.source}/${encodeURIComponent(this.site.name)}`);
    if (this.sources.find((one) => one.source === this.source.value) !== chosen) return;
    this.mesh = mesh;
    const before = this.field.value;
    replace(this.field, ...facts.fields.map((field) => el("option", { value: field.name }, `${field.title} (${field.unit})`)));
    this.titles = new Map(facts.fields.map((field) => [field.name, field]));
    this.field.value = this.titles.has(before) ? before : this.titles.has(FALLBACK) ? FALLBACK : facts.fields[0]?.name;
    if (this.viewer) {
      this.viewer.setMesh(mesh, facts.regions.map((_, i) => REGION_COLOURS(i, facts.regions.length)));
      this.viewer.setSites([{ name: this.site.name, at: this.site.position_mm, axis: this.site.axis, colour: this.site.fitted ? FITTED : HELD_OUT, filled: this.site.fitted }], 1.2);
      this.cut.set(mesh.points, this.frame, this.site);
      this.look();
      this.style();
    }
    await this.readFrames();
  }

  look() {
    if (!this.viewer || !this.mesh) return;
    this.viewer.lookAtAll(this.frame);
    if (this.site.position_mm) Object.assign(this.viewer.view, { target: this.site.position_mm.map((value, k) => value + 14 * this.site.axis[k]), half: 42 });
    this.cut.turn();
  }

  /** Read the chosen field at all moments, a few at once; done when the first, the deepest, is shown. */
  async readFrames() {
    const turn = ++this.turn, field = this.field.value, source = this.source.value;
    if (!this.mesh || !field) return;
    this.frames = this.times.map(() => null);
    const { deepest } = this.sources.find((one) => one.source === source);
    const first = Math.min(this.times.length - 1, this.at || deepest);
    const order = [first, ...this.times.keys()].filter((at, i, all) => all.indexOf(at) === i);
    const path = `results/moment/${source}/${encodeURIComponent(this.site.name)}`;
    const read = async (at) => {
      const { arrays, facts } = readArrays(await this.context.api.bytes(`${path}/${at}/${field}`));
      if (turn === this.turn) this.frames[at] = { moved: arrays.moved.values, values: arrays.values.values, on: facts.on, ends: endsOf(arrays.values.values) };
    };
    await read(order.shift());
    if (turn !== this.turn) return;
    this.scale();
    this.show(first);
    const worker = async () => {
      while (order.length && turn === this.turn) await read(order.shift());
    };
    Promise.all(Array.from({ length: AT_ONCE }, worker)).then(() => turn === this.turn && this.scale(), (error) => this.context.warn(error.message));
  }

  /** One colour range for all moments, or what was asked for. */
  scale() {
    const known = this.frames.filter(Boolean);
    if (!known.length || !this.viewer) return;
    const field = this.titles.get(this.field.value);
    const [low, high] = [Math.min(...known.map((one) => one.ends[0])), Math.max(...known.map((one) => one.ends[1]))];
    const asked = this.limits.map((input) => Number.parseFloat(input.value));
    const ends = [Number.isFinite(asked[0]) ? asked[0] : low, Number.isFinite(asked[1]) ? asked[1] : high];
    const beyond = [known.some((one) => one.ends[2] < ends[0]), known.some((one) => one.ends[3] > ends[1])];
    this.viewer.setColours({ map: this.map.value, low: ends[0], high: ends[1], beyond, title: `${field.title} (${field.unit})` });
  }

  style() {
    const warp = Number(this.warp.value);
    this.warpText.textContent = warp === 1 ? "as it is" : `${warp.toFixed(1)} times`;
    this.viewer?.setStyle({ edged: this.edges.checked, warp });
  }

  show(at) {
    this.at = at;
    this.slider.value = String(at);
    const frame = this.frames[at], time = this.times[at];
    this.slider.setAttribute("aria-valuetext", `${shortNumber(time)} s`);
    const field = this.titles?.get(this.field.value);
    const told = frame ? frame.ends.slice(2).map((value) => shortNumber(Math.abs(value) < 1e-6 ? 0 : value)) : null;
    const largest = told ? `; ${field.title} ${told.join(" to ")} ${field.unit}` : "; reading";
    this.words.textContent = `${shortNumber(time)} s${largest}`;
    this.moment(time);
    if (!frame || !this.viewer) return;
    const plain = { on: frame.on, values: frame.values };
    this.viewer.setMoment(frame.on === "cells" && this.smooth.checked ? nodalMeans(this.mesh, frame.values) : plain, frame.moved);
  }

  toggle() {
    if (this.playing) return this.stop();
    if (this.times.length < 2) return;
    if (this.at >= this.times.length - 1) this.show(0);
    let clock = this.times[this.at], before = null;
    const step = (now) => {
      if (!this.playing) return;
      clock += before === null ? 0 : ((now - before) / 1000) * Number(this.speed.value);
      before = now;
      let next = this.at;
      while (next + 1 < this.times.length && this.times[next + 1] <= clock) next++;
      if (next !== this.at && this.frames[next]) this.show(next);
      if (this.at >= this.times.length - 1) return this.stop();
      this.playing = requestAnimationFrame(step);
    };
    this.button.textContent = "❚❚ Pause";
    this.button.setAttribute("aria-label", "Pause");
    this.playing = requestAnimationFrame(step);
  }

  stop() {
    cancelAnimationFrame(this.playing ?? 0);
    this.playing = null;
    this.button.textContent = "▶ Play";
    this.button.setAttribute("aria-label", "Play");
  }
}

/** First and last percent of the values for colours, and their true ends for words. */
function endsOf(values) {
  const sorted = Float32Array.from(values).sort(), last = sorted.length - 1;
  return [sorted[Math.floor(0.01 * last)], sorted[Math.ceil(0.995 * last)], sorted[0], sorted[last]];
}
