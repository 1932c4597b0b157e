// The view Socket: the shape with its areas, runs started, and stored runs stepped through, two beside each other.
import { el, replace, table } from "/static/dom.js";
import { labelled, NAVIGATION, runButton, SIDES } from "/static/views/parts.js";
import { ShapeEditor } from "/static/views/socket_areas.js";
import { link, Pane } from "/static/views/socket_pane.js";

const FIELDS = { pressure: "contact pressure", shear: "shear" };
const RUNS = "runs", SHAPE = "shape";
const CELLS = { "": "not shown", measured_kPa: "measured (kPa)", model_kPa: "model (kPa)", difference: "model minus measured (kPa)" };

export function mount(element, context) {
  const view = new SocketView(element, context);
  view.refresh();
  context.on((changed) => (changed.study || changed.stages || changed.log || changed.run) && view.refresh());
  return { show: () => view.panes.forEach((pane) => pane.viewer?.resize()) };
}

class SocketView {
  constructor(element, context) {
    Object.assign(this, { element, context, runs: [], turn: 0, marks: "", frame: null });
    const side = el("div", { class: "side", tabindex: "0", role: "region", "aria-label": "Settings of the socket" });
    const main = el("div", { class: "stagearea results-main" });
    element.classList.add("split");
    element.append(side, main);
    const choice = (entries, act) => el("select", { onchange: act }, ...entries.map(([key, text]) => el("option", { value: key }, text)));
    this.mode = choice([[RUNS, "stored runs"], [SHAPE, "its shape"]], () => this.switch());
    this.run = choice([], () => this.reread(() => this.load()));
    this.beside = choice([["", "nothing"]], () => this.reread(() => this.load()));
    this.field = choice(Object.entries(FIELDS).map(([key, text]) => [key, `${text} (kPa)`]), () => this.reread(() => this.read()));
    this.colours = choice(["viridis", "cividis"].map((name) => [name, name]), () => (this.shaping ? this.editor.paint() : this.scale()));
    this.cells = choice(Object.entries(CELLS), () => this.showCells());
    this.cellWords = el("output", { class: "hint socket-cells" });
    this.slider = el("input", { type: "range", min: "0", max: "0", step: "1", value: "0", "aria-label": "step", oninput: () => this.show() });
    this.words = el("output", { class: "player-words" });
    this.pointed = el("output", { class: "hint socket-pointed" });
    this.table = el("div", { class: "padded table-box", tabindex: "0", role: "region", "aria-label": "Regions" });
    this.stages = el("div", { class: "socket-stages" });
    this.bar = el("div", { class: "player-bar" }, this.slider, this.words);
    main.append(this.stages, this.bar, this.table);
    this.panes = [this.pane()];
    this.editor = new ShapeEditor(this);
    if (this.viewer) Object.assign(this.viewer, { onSite: (name) => (this.shaping ? this.editor.choose(name) : this.showCells(name)), onMesh: (point) => this.shaping && this.editor.placed(point) });
    this.ofRuns = el("div", {}, labelled("run", this.run), labelled("beside it", this.beside), labelled("show", this.field),
      (this.ofCells = el("div", {}, labelled("sensors", this.cells), this.cellWords)));
    const starters = (name) => [["Run the socket", false], ["Run the design", true]].map(([text, design]) =>
      el("button", { type: "button", class: name, onclick: () => this.start(design) }, text));
    this.starters = starters();
    this.offers = starters("main");
    this.toSurfaces = runButton(context, "surfaces");
    this.stop = el("button", { type: "button", onclick: () => this.post("identification/stop", {}, "was asked to stop; what is finished is kept") }, "Stop");
    this.progress = el("p", { class: "hint", role: "status" });
    replace(side, labelled("view", this.mode), this.ofRuns, this.editor.part, labelled("colours", this.colours),
      el("div", { class: "row", role: "group", "aria-label": "Side of the limb" },
        SIDES.map(([name, azimuth]) => el("button", { type: "button", onclick: () => this.viewer?.view.side(azimuth) }, name))),
      el("p", { class: "hint" }, NAVIGATION), (this.underPointer = el("h2", {}, "Under the pointer")), this.pointed,
      el("h2", {}, "Run"), el("div", { class: "row" }, this.starters, this.stop), this.progress);
    this.arrange();
  }

  get viewer() {
    return this.panes[0].viewer;
  }

  get shaping() {
    return this.mode.value === SHAPE;
  }

  map() {
    return this.colours.value;
  }

  pane() {
    const pane = new Pane(this.stages, this.context);
    pane.viewer?.canvas.addEventListener("pointermove", (event) => {
      if (!this.shaping) this.pointed.textContent = pane.pointed(event, FIELDS[this.field.value]);
    });
    return pane;
  }

  arrange() {
    this.ofRuns.hidden = this.underPointer.hidden = this.pointed.hidden = this.shaping || !this.runs.length;
    this.editor.part.hidden = !this.shaping;
    this.bar.hidden = this.table.hidden = this.shaping;
  }

  async switch() {
    this.arrange();
    this.editor.leave();
    this.compareWith(null);
    this.panes[0].clear();
    this.marks = "";
    await this.refresh();
  }

  refresh() {
    return this.reread(() => this.readAll());
  }

  reread(read) {
    return this.context.load(this.element, this.shaping ? "the shape of the socket" : "the runs of the socket", read);
  }

  async readAll() {
    const { api } = this.context, found = await api.get("socket");
    this.frame = found.frame;
    this.tellRun(found);
    if (this.shaping) {
      const shape = await api.get("socket/shape"), marks = JSON.stringify(shape);
      if (!this.shaping) return; // another view was chosen meanwhile
      if (marks !== this.marks) await this.editor.take(shape);
      this.marks = marks;
      return shape.has_limb ? null : { text: "There is no limb yet to draw a socket around.", actions: [this.toSurfaces] };
    }
    const marks = JSON.stringify([found.runs, found.frame]);
    if (marks !== this.marks) {
      Object.assign(this, { marks, runs: found.runs });
      this.arrange();
      this.options(this.run, found.runs);
      this.options(this.beside, found.runs, [["", "nothing"]]);
      try {
        await this.load();
      } catch (error) {
        this.marks = ""; // read again the next time
        throw error;
      }
    }
    if (this.runs.length) return;
    if (found.run || found.starting) return { text: "The study is running. A run of its socket appears here once it is stored." };
    return {
      text: "No run of the socket is stored yet. It computes pressure and shear on the limb (limbfit socket); the design searches a better shape (limbfit socket design).",
      actions: this.offers,
    };
  }

  options(select, runs, first = []) {
    const before = select.value;
    replace(select, ...[...first, ...runs.map((one) => [one.run, one.run])].map(([key, text]) => el("option", { value: key }, text)));
    if ([...select.options].some((one) => one.value === before)) select.value = before;
  }

  tellRun({ run, starting, last }) {
    const busy = Boolean(run || starting);
    for (const button of this.starters) button.disabled = busy;
    this.stop.disabled = !busy;
    const now = last?.now;
    this.progress.textContent = busy ? (now ? `${now.stage}: ${now.text}` : "Starting …") : last?.error ?? "";
    this.progress.className = !busy && last?.error ? "bad" : "hint";
    clearTimeout(this.soon);
    if (starting && !run) this.soon = setTimeout(() => this.refresh(), 1500);
  }

  start(design) {
    return this.post("socket/start", { design }, "was started");
  }

  async post(path, values, text) {
    try {
      const { process } = await this.context.api.post(path, values);
      this.context.say(`Process ${process} ${text}.`);
    } catch (error) {
      this.context.warn(error.message);
    }
    this.context.refresh();
    await this.refresh();
  }

  /** A second picture beside the first, or none. */
  compareWith(run) {
    if (run && !this.panes[1]) {
      this.panes.push(this.pane());
      if (this.viewer) link(this.viewer, this.panes[1].viewer);
    } else if (!run && this.panes[1]) this.panes.pop().close();
    this.stages.classList.toggle("two-panes", Boolean(run));
    for (const pane of this.panes) pane.viewer?.resize();
  }

  async load() {
    const turn = ++this.turn, find = (name) => this.runs.find((one) => one.run === name);
    const chosen = find(this.run.value), other = find(this.beside.value);
    this.chosen = chosen;
    for (const part of [this.run, this.beside, this.field, this.slider]) part.disabled = !chosen;
    this.compareWith(chosen && other);
    this.panes[0].clear();
    if (!chosen) return replace(this.table), (this.words.textContent = "");
    this.slider.max = String(chosen.steps.length - 1);
    const wanted = [chosen, other].filter(Boolean);
    await Promise.all(wanted.map((run, i) => this.panes[i].load(run, this.frame)));
    if (turn === this.turn) await this.read();
  }

  /** The chosen field at all steps. */
  async read() {
    const turn = this.turn;
    if (this.panes.some((pane) => !pane.run)) return;
    await Promise.all(this.panes.map((pane) => pane.read(this.field.value)));
    if (turn !== this.turn) return;
    this.scale();
    this.show();
  }

  /** One colour range for all steps and both pictures, from zero to the largest value of all. */
  scale() {
    if (this.panes.some((pane) => !pane.frames.length)) return;
    const high = Math.max(...this.panes.map((pane) => pane.high));
    for (const pane of this.panes) pane.scale(this.map(), high, `${FIELDS[this.field.value]} (kPa)`);
    this.showCells();
  }

  show() {
    const at = Number(this.slider.value), name = this.chosen?.steps[at]?.name;
    const told = this.panes.map((pane) => pane.show(name, at, FIELDS[this.field.value]));
    if (told.includes(null)) return;
    this.words.textContent = told.length > 1 ? told.map((text, i) => `${this.panes[i].run.run}: ${text}`).join(" | ") : told[0];
    this.slider.setAttribute("aria-valuetext", name);
    const outside = this.panes[0].run.outside.map((text) => el("p", { class: "hint doubt" }, `⚠ ${text}`));
    const agreed = this.panes[0].run.agreement.filter((row) => row.load === name);
    replace(this.table, told.length > 1 ? compared(this.panes) : single(this.panes[0].step),
      ...(agreed.length ? [agreement(agreed, name)] : []), ...outside);
    this.showCells();
  }

  /** Cells of sensors that recorded the step, in the chosen quantity; the chosen one in words. */
  showCells(chosen) {
    const [pane] = this.panes, step = pane.step?.name;
    const cells = (pane.run?.sensors ?? []).filter((one) => one.load === step).flatMap((one) => one.cells.map((cell) => ({ ...cell, sensor: one.name })));
    this.ofCells.hidden = !pane.run?.sensors.length;
    const cell = cells.find((one) => one.cell === chosen), what = this.cells.value;
    const means = pane.run ? pane.showCells(what ? cells : [], what, this.map(), pane.shared, cell) : "";
    this.cellWords.textContent = what && !cells.length ? "no sensor recorded this step" : means;
    if (cell) this.pointed.textContent = describeCell(cell);
  }
}

const number = (value) => value.toFixed(1);

function single(step) {
  return table(["region", "mean (kPa)", "95 % (kPa)", "peak (kPa)", "shear (kPa)"],
    step.regions.map((row) => [row.region, number(row.mean_kPa), row.interval_kPa?.map(number).join(" to ") ?? "–", number(row.peak_kPa), number(row.shear_kPa)]),
    `Regions, ${step.name}`);
}

function describeCell(cell) {
  const read = cell.measured_kPa === null ? "no reading" : `measured ${number(cell.measured_kPa)} ± ${number(cell.error_kPa)} kPa`;
  const interval = cell.interval_kPa ? ` (95 %: ${cell.interval_kPa.map(number).join(" to ")})` : "";
  return `cell ${cell.cell} of ${cell.sensor}: ${read}, model ${number(cell.model_kPa)} kPa${interval}; ${cell.state}; ${cell.regions[0] ?? "no region"}`;
}

/** How model and measured pressures agree by region (Bland and Altman). */
function agreement(rows, name) {
  return table(["region", "cells", "measured (kPa)", "model (kPa)", "model minus measured (kPa)", "95 % of differences (kPa)", "within errors (%)"],
    rows.map((row) => [row.region, String(row.cells), number(row.measured_kPa), number(row.model_kPa), number(row.bias_kPa),
      row.limits_kPa?.map(number).join(" to ") ?? "–", String(Math.round(row.within_percent))]), `Measured pressures, ${name}`);
}

/** Means and peaks of two runs, and by how much the second's peak differs. */
function compared([one, other]) {
  const names = [one.run.run, other.run.run], rows = one.step.regions.map((row) => [row, other.step.regions.find((same) => same.region === row.region)]);
  return table(["region", ...names.map((name) => `mean (kPa), ${name}`), ...names.map((name) => `peak (kPa), ${name}`), "change of peak (%)"],
    rows.map(([row, same]) => {
      const change = same && row.peak_kPa > 0 ? Math.round(100 * (same.peak_kPa / row.peak_kPa - 1)) : null;
      const sign = change > 0 ? "+" : change < 0 ? "−" : "";
      return [row.region, number(row.mean_kPa), same ? number(same.mean_kPa) : "–", number(row.peak_kPa), same ? number(same.peak_kPa) : "–",
        change === null ? "–" : `${sign}${Math.abs(change)}`];
    }), `Regions, ${one.step.name}`);
}
