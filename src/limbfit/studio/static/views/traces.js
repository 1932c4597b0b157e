// The view Traces: records raw and regularised; touch-down and peak are dragged and stored in the study file.
import { el, replace } from "/static/dom.js";
import { HandledChart } from "/static/handles.js";
import { LivePanel } from "/static/views/live.js";
import { upload } from "/static/views/start.js";

const TIME = { title: "Time", unit: "s" };
const FORCE = { title: "Force", unit: "N" };
const DEPTH = { title: "Displacement", unit: "mm" };
const PREVIEW_MS = 250;

export function mount(element, context) {
  const view = new TracesView(element, context);
  const live = new LivePanel(view.live, context, (site) => view.choose(site));
  context.on((changed) => changed.acquired && live.look());
  context.on((changed) => changed.theme && live.draw(true));
  live.look();
  view.refresh();
  context.on((changed) => (changed.study || changed.stages || changed.acquired) && view.refresh());
  context.on((changed) => changed.theme && view.charts.forEach((chart) => chart.draw()));
  return { show: () => live.show(), hide: () => live.hide() };
}

class TracesView {
  constructor(element, context) {
    this.context = context;
    this.charts = [];
    this.site = null;
    this.found = { sites: [], flags: [] };
    element.classList.add("split");
    this.element = element;
    this.side = el("div", { class: "side" });
    this.head = el("div", {});
    this.area = el("div", { class: "record" });
    this.live = el("section", { class: "card", id: "live", "aria-label": "The session that is being recorded", hidden: true });
    element.append(this.side, el("div", { class: "stagearea padded" }, this.live, this.head, this.area));
  }

  async refresh() {
    if (this.dragging) return;
    await this.context.load(this.element, "the records", () => this.readSites());
    if (this.element.dataset.state !== "ready") return;
    await this.open(this.site);
    await this.judge();
  }

  async readSites() {
    this.sites = (this.context.study ?? (await this.context.api.get("study"))).indentations;
    if (!this.sites.some((site) => site.name === this.site)) this.site = (this.sites.find((site) => site.is_recorded) ?? this.sites[0])?.name;
    this.list();
    if (!this.sites.length) return { text: "The study names no sites. Add them under Model, or as [[sites]] of study.toml." };
  }

  /** All records are read for this, which takes seconds where there are many. */
  async judge() {
    try {
      this.found = await this.context.api.get("traces");
    } catch (error) {
      this.context.warn(error.message);
      return;
    }
    this.list();
    this.doubts();
  }

  list() {
    const focused = this.side.contains(document.activeElement) ? document.activeElement.dataset.site : null;
    const rows = this.sites.map((site) => {
      const error = this.found.sites.find((row) => row.site === site.name)?.error;
      const flags = this.flags(site.name).length;
      const notes = [site.fitted ? "fitted" : "held out", site.region];
      if (!site.is_recorded) notes.push(site.has_trace ? "to be recorded" : "no record");
      if (error) notes.push("unreadable");
      if (site.touch_down_s !== null || site.peak_s !== null) notes.push("set by hand");
      return el("li", {}, el("button", { type: "button", class: "site", "data-site": site.name, "aria-pressed": String(site.name === this.site),
        onclick: () => this.choose(site.name) },
      el("strong", {}, site.name), el("span", {}, notes.filter(Boolean).join(", ")),
      flags || error ? el("span", { class: "flagged" }, `⚠ ${flags || 1}`) : null));
    });
    replace(this.side, el("h2", {}, "Records"), el("ul", { class: "plain sites" }, rows),
      el("p", { class: "hint" }, "⚠ counts what is doubtful about a record. Drag touch-down or peak, or move it with the arrow keys: the time is stored in the study file at once."));
    if (focused) this.side.querySelector(`[data-site="${CSS.escape(focused)}"]`)?.focus();
  }

  flags(name) {
    return this.found.flags.filter((flag) => flag.sites.includes(name));
  }

  doubts() {
    if (this.flagList) replace(this.flagList, this.flags(this.site).map((flag) => el("li", { class: "doubt" }, `⚠ ${flag.text}`)));
  }

  async choose(name) {
    this.site = name;
    this.list();
    this.side.querySelector(`[data-site="${CSS.escape(name)}"]`)?.focus();
    await this.open(name);
  }

  close() {
    this.charts.forEach((chart) => chart.close());
    this.charts = [];
  }

  open(name) {
    const site = this.sites.find((one) => one.name === name);
    this.flagList = el("ul", { class: "plain flags" });
    this.doubts();
    replace(this.head, el("h2", {}, `Site ${name}${site.region ? `, ${site.region}` : ""}`), this.flagList);
    return this.context.load(this.area, `the record of site ${name}`, () => this.read(site));
  }

  async read(site) {
    const turn = (this.turn = (this.turn ?? 0) + 1);
    this.area.ondrop = null;
    if (!site.is_recorded) {
      this.close();
      return { text: site.has_trace ? `Its record is yet to be made: limbfit acquire STUDY --site ${site.name}` : "This site has no record: it is planned to be simulated. Drop its record here, or choose the file.", actions: site.has_trace ? [] : this.attaching(site) };
    }
    const record = await this.context.api.get(`traces/${encodeURIComponent(site.name)}`);
    if (turn !== this.turn) return;
    this.close();
    this.record = record;
    const [force, depth, loop] = [0, 1, 2].map(() => el("div", {}));
    this.facts = el("dl", { class: "facts", id: "trace-facts" });
    this.reset = el("button", { type: "button", id: "trace-reset", onclick: () => this.store({ touch_down_s: null, peak_s: null }) }, "Let limbfit find both");
    replace(this.area, force, el("div", { class: "pair" }, depth, loop), el("div", { class: "row" }, this.reset), this.facts);
    this.charts = [
      new HandledChart(force, this.content("force_N", FORCE, true), 300),
      new HandledChart(depth, this.content("displacement_mm", DEPTH, true), 240),
      new HandledChart(loop, this.loop(), 240),
    ];
    this.tell();
  }

  /** A place to drop a record of the site on, and whether the site is fitted. */
  attaching(site) {
    const fitted = el("input", { type: "checkbox", checked: true });
    const take = async (file) => {
      try {
        const path = await upload(this.context, file, `traces/${file.name}`);
        const facts = await this.context.api.post(`traces/${encodeURIComponent(site.name)}/record`, { path, fitted: fitted.checked });
        this.context.say(`The record of site ${site.name}: ${facts.peak_force_N.toFixed(2)} N at ${facts.depth_mm.toFixed(2)} mm.`);
      } catch (error) {
        this.context.warn(error.message);
      }
      await this.context.refresh();
    };
    const input = el("input", { type: "file", "aria-label": `record of site ${site.name}`, onchange: () => input.files[0] && take(input.files[0]) });
    this.area.ondragover = (event) => event.preventDefault();
    this.area.ondrop = (event) => {
      event.preventDefault();
      if (event.dataTransfer.files[0]) take(event.dataTransfer.files[0]);
    };
    return [input, el("label", { class: "row" }, fitted, "fitted (otherwise held out)")];
  }

  series(key) {
    const { raw, regularised, facts } = this.record;
    const lift = key === "displacement_mm" ? facts.touch_down_mm : 0;
    return [
      { label: "as recorded", colour: "--muted", width: 1, x: raw.time_s, y: raw[key] },
      { label: "regularised", colour: "--simulated", width: 2.5, x: regularised.time_s, y: regularised[key].map((value) => value + lift) },
    ];
  }

  content(key, axis) {
    return { label: `${axis.title} against time at site ${this.site}.`, x: TIME, y: axis, series: this.series(key), handles: this.handles() };
  }

  loop() {
    const { displacement_mm: x, force_N: y } = this.record.regularised;
    return { label: `Force against displacement at site ${this.site}.`, x: { ...DEPTH, title: "Displacement from touch-down" }, y: FORCE,
      series: [{ label: "regularised", colour: "--simulated", width: 2.5, x, y }] };
  }

  handles() {
    const { facts, raw } = this.record;
    const [first, last] = [raw.time_s[0], raw.time_s.at(-1)];
    const make = (key, label, low, high) => ({ key, label, unit: "s", value: facts[key], low, high, step: Math.max(this.record.step_s, 0.005), colour: "--second",
      onmove: (value) => this.moved(key, value), ondrop: (value) => this.dropped(key, value) });
    return [make("touch_down_s", "Touch-down", first, facts.peak_s - 0.05), make("peak_s", "Peak", facts.touch_down_s + 0.05, last)];
  }

  wanted(key, value) {
    return { ...this.record.stated, [key]: value };
  }

  moved(key, value) {
    this.dragging = true;
    this.context.say(`${key === "peak_s" ? "Peak" : "Touch-down"} at ${value.toFixed(3)} s`);
    if (this.waiting) return;
    this.waiting = setTimeout(async () => {
      this.waiting = null;
      if (!this.dragging) return;
      const { site } = this;
      try {
        const seen = await this.context.api.post(`traces/${encodeURIComponent(site)}/preview`, this.wanted(key, this.latest(key)));
        if (!this.dragging || site !== this.site) return;
        this.record = { ...seen, stated: this.record.stated };
        this.redraw();
      } catch (error) {
        this.context.say(error.message);
      }
    }, PREVIEW_MS);
    this.last = { key, value };
  }

  latest(key) {
    return this.last?.key === key ? this.last.value : this.record.facts[key];
  }

  async dropped(key, value) {
    this.dragging = false;
    clearTimeout(this.waiting);
    this.waiting = null;
    await this.store(this.wanted(key, value));
  }

  async store(times) {
    try {
      this.record = await this.context.api.post(`traces/${encodeURIComponent(this.site)}`, times);
      this.context.say(`Stored in the study file: touch-down ${this.said("touch_down_s")}, peak ${this.said("peak_s")}. The stage traces is stale now.`);
      this.context.refresh();
    } catch (error) {
      this.context.warn(`Not stored: ${error.message}`);
    }
    const focus = document.activeElement?.dataset?.key;
    await this.refresh();
    if (focus) this.area.querySelector(`[data-key="${focus}"]`)?.focus();
  }

  said(key) {
    const value = this.record.stated[key];
    return value === null ? "as found" : `${value.toFixed(3)} s`;
  }

  redraw() {
    this.charts[0].renew(this.series("force_N"));
    this.charts[1].renew(this.series("displacement_mm"));
    this.charts[2].renew(this.loop().series);
    this.tell();
  }

  tell() {
    const { facts, stated, samples } = this.record;
    const by = (key) => (stated[key] === null ? "found by limbfit" : "set by hand");
    const number = (value, digits) => (value === null || value === undefined ? "–" : value.toFixed(digits));
    const rows = [
      ["Touch-down", `${number(facts.touch_down_s, 3)} s, at ${number(facts.touch_down_mm, 2)} ± ${number(facts.touch_down_uncertainty_mm, 2)} mm of the record (${by("touch_down_s")})`],
      ["Peak", `${number(facts.peak_s, 3)} s (${by("peak_s")})`],
      ["Depth from touch-down", `${number(facts.depth_mm, 2)} mm`],
      ["Largest force", `${number(facts.peak_force_N, 2)} N, noise ${number(facts.noise_N, 3)} N`],
      ["Phases", facts.phases_in_words],
      ["Speed in, out", `${number(facts.speed_load_mm_s, 2)}, ${number(facts.speed_unload_mm_s, 2)} mm/s`],
      ["Samples", samples.toLocaleString("en")],
    ];
    replace(this.facts, rows.flatMap(([name, text]) => [el("dt", {}, name), el("dd", {}, text)]));
    this.reset.disabled = Object.values(stated).every((value) => value === null);
  }
}
