// The view Socket: stored runs of a socket, the limb coloured by pressure through donning and loads.
import { el, replace, table } from "/static/dom.js";
import { readArrays } from "/web/arrays.js";
import { shortNumber } from "/web/colours.js";
import { canDraw, Viewer } from "/web/viewer.js";
import { labelled, loadMesh, NAVIGATION, NO_WEBGL, REGION_COLOURS, SIDES } from "/static/views/parts.js";

const FIELDS = { pressure: "contact pressure", shear: "shear" };
const NONE = "No socket run is stored: limbfit socket STUDY makes one, limbfit socket design STUDY designs.";

export async function mount(element, context) {
  const view = new SocketView(element, context);
  await view.refresh();
  context.on((changed) => changed.stages && view.refresh());
  return { show: () => view.viewer?.resize() };
}

class SocketView {
  constructor(element, context) {
    Object.assign(this, { context, runs: [], frames: [], turn: 0, mesh: null, marks: "" });
    const side = el("div", { class: "side", tabindex: "0", role: "region", "aria-label": "Settings of the socket" });
    const main = el("div", { class: "stagearea results-main" });
    this.stage = el("div", { class: "player-stage" });
    element.classList.add("split");
    element.append(side, main);
    this.run = el("select", { onchange: () => this.load() });
    this.field = el("select", { onchange: () => this.read() }, ...Object.entries(FIELDS).map(([key, text]) => el("option", { value: key }, `${text} (kPa)`)));
    this.map = el("select", { onchange: () => this.scale() }, ...["viridis", "cividis"].map((name) => el("option", { value: name }, name)));
    this.slider = el("input", { type: "range", min: "0", max: "0", step: "1", value: "0", "aria-label": "step", oninput: () => this.show() });
    this.words = el("output", { class: "player-words" });
    this.pointed = el("output", { class: "hint socket-pointed" });
    this.table = el("div", { class: "padded table-box", tabindex: "0", role: "region", "aria-label": "Regions" });
    this.none = el("p", { class: "padded", hidden: true }, NONE);
    main.append(this.none, this.stage, el("div", { class: "player-bar" }, this.slider, this.words), this.table);
    if (canDraw()) {
      this.viewer = new Viewer(this.stage, "The limb coloured by what the socket does to it.");
      this.viewer.canvas.addEventListener("pointermove", (event) => this.point(event));
    } else this.stage.append(el("p", { class: "padded failed" }, NO_WEBGL));
    replace(side, labelled("run", this.run), labelled("show", this.field), labelled("colours", this.map),
      el("div", { class: "row", role: "group", "aria-label": "Side of the limb" },
        SIDES.map(([name, azimuth]) => el("button", { type: "button", onclick: () => this.viewer?.view.side(azimuth) }, name))),
      el("p", { class: "hint" }, NAVIGATION), el("h2", {}, "Under the pointer"), this.pointed);
  }

  async refresh() {
    try {
      const found = await this.context.api.get("socket"), marks = JSON.stringify(found);
      if (marks === this.marks) return;
      Object.assign(this, { marks, runs: found.runs, frame: found.frame });
      const before = this.run.value;
      replace(this.run, ...found.runs.map((one) => el("option", { value: one.run }, one.run)));
      if (found.runs.some((one) => one.run === before)) this.run.value = before;
      await this.load();
    } catch (error) {
      this.context.warn(error.message);
    }
  }

  async load() {
    const turn = ++this.turn, chosen = this.runs.find((one) => one.run === this.run.value);
    this.none.hidden = Boolean(chosen);
    this.stage.hidden = !chosen;
    Object.assign(this, { chosen, mesh: null, frames: [] });
    for (const part of [this.run, this.field, this.map, this.slider]) part.disabled = !chosen;
    this.viewer?.setMesh(null);
    this.viewer?.setColours(null);
    if (!chosen) return replace(this.table), (this.words.textContent = "");
    this.slider.max = String(chosen.steps.length - 1);
    try {
      const { mesh, arrays, facts } = await loadMesh(this.context, `socket/mesh/${encodeURIComponent(chosen.run)}`);
      if (turn !== this.turn) return;
      Object.assign(this, { mesh, place: arrays.place.values, places: facts.places });
      this.viewer?.setMesh(mesh, facts.regions.map((_, i) => REGION_COLOURS(i, facts.regions.length)));
      this.viewer?.setStyle({ edged: false });
      this.viewer?.lookAtAll(this.frame);
      await this.read();
    } catch (error) {
      this.context.warn(error.message);
    }
  }

  /** The chosen field at all steps. */
  async read() {
    const turn = ++this.turn, { chosen } = this;
    if (!this.mesh) return;
    try {
      const path = `socket/step/${encodeURIComponent(chosen.run)}`;
      const frames = await Promise.all(chosen.steps.map(async (_, at) =>
        readArrays(await this.context.api.bytes(`${path}/${at}/${this.field.value}`)).arrays.values.values));
      if (turn !== this.turn) return;
      this.frames = frames;
      this.scale();
      this.show();
    } catch (error) {
      this.context.warn(error.message);
    }
  }

  /** One colour range for all steps, from zero to the largest value of all. */
  scale() {
    if (!this.frames.length) return;
    const high = Math.max(...this.frames.map(largest));
    this.viewer?.setColours({ map: this.map.value, low: 0, high, beyond: [false, false], title: `${FIELDS[this.field.value]} (kPa)` });
  }

  show() {
    const at = Number(this.slider.value), step = this.chosen?.steps[at], values = this.frames[at];
    if (!values) return;
    const settled = typeof step.settling_mm === "number" ? `; settles by ${step.settling_mm.toFixed(1)} mm` : "";
    this.words.textContent = `${step.name}; ${FIELDS[this.field.value]} at most ${shortNumber(largest(values))} kPa at a node${settled}`;
    this.slider.setAttribute("aria-valuetext", step.name);
    this.viewer?.setMoment({ on: "nodes", values }, null);
    const number = (value) => value.toFixed(1);
    replace(this.table, table(["region", "mean (kPa)", "95 % (kPa)", "peak (kPa)", "shear (kPa)"],
      step.regions.map((row) => [row.region, number(row.mean_kPa), row.interval_kPa?.map(number).join(" to ") ?? "–", number(row.peak_kPa), number(row.shear_kPa)]),
      `Regions, ${step.name}`));
  }

  /** What the node nearest to the pointer bears. */
  point(event) {
    const values = this.frames[Number(this.slider.value)], hit = values && this.viewer.meshAt(event);
    if (!hit) return (this.pointed.textContent = "");
    const { points } = this.mesh;
    let node = 0, near = Infinity;
    for (let i = 0; i < points.length / 3; i++) {
      const far = (points[3 * i] - hit[0]) ** 2 + (points[3 * i + 1] - hit[1]) ** 2 + (points[3 * i + 2] - hit[2]) ** 2;
      if (far < near) [node, near] = [i, far];
    }
    const place = this.places[this.place[node]] || "no region";
    this.pointed.textContent = `${FIELDS[this.field.value]} ${shortNumber(values[node])} kPa; ${place}`;
  }
}

function largest(values) {
  return values.reduce((most, value) => Math.max(most, value), 0);
}
