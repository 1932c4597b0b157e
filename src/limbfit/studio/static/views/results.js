// The view Results: fields played, forces, tables, runs compared, files to keep.
import { el, replace, table } from "/static/dom.js";
import { Chart } from "/web/chart.js";
import { shortNumber } from "/web/colours.js";
import { labelled, NAVIGATION } from "/static/views/parts.js";
import { Player } from "/static/views/player.js";

const GREEK = { gamma: "γ", tau: "τ" };
const below = (digits) => [...digits].map((digit) => "₀₁₂₃₄₅₆₇₈₉"[digit]).join("");
const parted = (key) => { const [, name, digits, unit] = /^(.*?)(\d*)(?:_(kPa|s))?$/.exec(key); return [(GREEK[name] ?? name) + below(digits), unit ?? "–"]; };
const AXES = { time_s: { title: "Time", unit: "s" }, displacement_mm: { title: "Displacement", unit: "mm" } };
const WATCH_MS = 1500;

export function mount(element, context) {
  const view = new ResultsView(element, context);
  view.refresh();
  context.on((changed) => {
    if (changed.theme) view.chart?.draw();
    if (changed.study || changed.stages) view.refresh();
  });
  return { show: () => { view.player.viewer?.resize(); view.watch(); }, hide: () => { view.player.stop(); clearTimeout(view.watching); } };
}

class ResultsView {
  constructor(element, context) {
    Object.assign(this, { element, context, other: "", chosen: null, against: "time_s", time: null });
    element.classList.add("split");
    this.player = new Player(context, (time) => this.mark(time));
    this.site = el("select", { onchange: () => this.choose(this.site.value) });
    this.simulation = el("div", {});
    this.files = el("div", {});
    const side = el("div", { class: "side", tabindex: "0", role: "region", "aria-label": "Settings of the results" },
      el("h2", {}, "Site"), labelled("site", this.site), this.simulation, this.player.settings,
      el("p", { class: "hint" }, NAVIGATION), this.files);
    this.curveBox = el("div", {});
    this.axis = el("select", { onchange: () => { this.against = this.axis.value; this.drawCurves(); } },
      el("option", { value: "time_s" }, "time (s)"), el("option", { value: "displacement_mm" }, "displacement (mm)"));
    this.compareWith = el("select", { onchange: () => this.compare(this.compareWith.value) });
    this.keepName = el("input", { maxlength: "40", "aria-label": "name to keep this run under", placeholder: "name of this run" });
    this.drop = el("button", { type: "button", onclick: () => this.dropKept() }, "Forget it");
    this.compared = el("div", { class: "table-box", tabindex: "0", role: "region", "aria-label": "Tables of the results" });
    this.main = el("div", { class: "stagearea results-main" }, this.player.stage, this.player.bar,
      el("div", { class: "cards padded" },
        el("section", { class: "card force" }, el("div", { class: "row" }, el("h2", {}, "Force"), el("label", { class: "row" }, "against", this.axis)), this.curveBox),
        el("section", { class: "card" }, el("h2", {}, "This run beside another"),
          el("div", { class: "row" }, el("label", { class: "row" }, "beside", this.compareWith), this.drop),
          el("form", { class: "row", onsubmit: (event) => { event.preventDefault(); this.keep(); } }, this.keepName, el("button", { type: "submit" }, "Keep this run")),
          el("p", { class: "hint" }, "What is kept are parameters, errors and curves; they stay in results/kept.")),
        el("section", { class: "card wide" }, this.compared)));
    element.append(side, this.main);
  }

  refresh() {
    return this.context.load(this.element, "the results", () => this.read());
  }

  async read() {
    const { api } = this.context;
    [this.outcome, this.scene] = await Promise.all([api.get("results"), api.get("model/scene")]);
    if (this.other && !this.outcome.kept.some((run) => run.name === this.other)) this.other = "";
    this.beside = this.other ? await api.get(`results?kept=${encodeURIComponent(this.other)}`) : null;
    const sites = this.scene.sites.flatMap((site) => (site.records.length ? site.records.map((name) => ({ ...site, name })) : [site]));
    this.indentations = sites;
    replace(this.site, ...sites.map((site) => el("option", { value: site.name }, [site.name, site.region, site.fitted ? "fitted" : "held out"].filter(Boolean).join(", "))));
    if (!sites.some((site) => site.name === this.chosen)) this.chosen = (sites.find((site) => site.records.length) ?? sites[0])?.name ?? null;
    this.showRuns();
    if (this.chosen !== null) this.choose(this.chosen);
    else return { text: "The study names no sites." };
  }

  async choose(name) {
    this.chosen = this.site.value = name;
    try {
      const found = await this.context.api.get(`results/site/${encodeURIComponent(name)}`);
      if (this.chosen !== name) return;
      this.showSite(found);
      await Promise.all([this.readCurves(), this.openPlayer(name, found.sources)]);
    } catch (error) {
      this.context.warn(error.message);
    }
  }

  /** Again only where what is stored has changed, so that nothing is read for nothing. */
  async openPlayer(name, sources) {
    const mark = JSON.stringify([name, sources]);
    if (mark === this.opened) return;
    this.opened = mark;
    await this.player.open(this.indentations.find((site) => site.name === name), sources, this.scene.frame);
  }

  showSite({ sources, downloads, simulating, failure }) {
    const animated = sources.find((one) => one.source === "simulate");
    const going = simulating?.site === this.chosen;
    const rows = [];
    if (simulating) rows.push(el("div", { class: "row" }, el("span", {}, `simulating site ${simulating.site}${going && animated ? `: ${animated.times_s.length} steps stored` : ""}`),
      el("button", { type: "button", onclick: () => this.act("results/stop", "The simulation ends.") }, "Stop")));
    else rows.push(el("button", { type: "button", onclick: () => this.act(`results/simulate/${encodeURIComponent(this.chosen)}`, "The simulation has begun; its steps appear as they are found.") },
      animated ? "Simulate every step again" : "Simulate every step, to play it"));
    if (animated?.parameters_from) rows.push(el("p", { class: "hint" }, `parameters of the steps: ${animated.parameters_from}`));
    if (failure) rows.push(el("p", { class: "bad" }, failure));
    replace(this.simulation, ...rows);
    this.showFiles(downloads);
    clearTimeout(this.watching);
    if (simulating) this.watching = setTimeout(() => this.watch(), WATCH_MS);
  }

  watch() {
    if (this.chosen !== null && !this.element.hidden) this.choose(this.chosen);
  }

  async act(path, text) {
    try {
      await this.context.api.post(path);
      this.context.say(text);
    } catch (error) {
      this.context.warn(error.message);
    }
    await this.choose(this.chosen);
  }

  showFiles(ofSite) {
    const link = ({ title, path }) => el("li", {}, el("a", { href: this.context.api.url(`files/${path.split("/").map(encodeURIComponent).join("/")}?download=true`), download: "" }, title));
    const feb = el("button", { type: "button", onclick: async () => {
      try {
        const { path } = await this.context.api.post(`results/feb/${encodeURIComponent(this.chosen)}`);
        this.context.say(`Written: results/${path}`);
        await this.choose(this.chosen);
      } catch (error) {
        this.context.warn(error.message);
      }
    } }, "Write the FEBio input (.feb)");
    const ofStudy = this.outcome.downloads, tables = ofStudy.filter((file) => file.path.includes("/tables/"));
    replace(this.files, el("h2", {}, "Download"), el("h3", {}, `Site ${this.chosen}`), el("ul", { class: "plain" }, ofSite.map(link)), feb,
      el("h3", {}, "Study"), el("ul", { class: "plain" }, ofStudy.filter((file) => !tables.includes(file)).map(link)),
      tables.length ? el("details", {}, el("summary", {}, "tables (CSV)"), el("ul", { class: "plain" }, tables.map(link))) : null);
  }

  async readCurves() {
    const name = this.chosen, path = `results/curves/${encodeURIComponent(name)}`;
    const read = (more) => this.context.api.get(path + more).catch(() => null);
    const has = (run) => run?.sites.some((row) => row.record === name);
    const [ours, theirs] = await Promise.all([has(this.outcome) ? read("") : null, has(this.beside) ? read(`?kept=${encodeURIComponent(this.other)}`) : null]);
    if (name !== this.chosen) return;
    this.curves = { ours, theirs };
    this.drawCurves();
  }

  drawCurves() {
    const { ours, theirs } = this.curves ?? {};
    if (!ours) {
      this.chart?.close();
      this.chart = null;
      return replace(this.curveBox, el("p", { class: "hint" }, "No forces are predicted at this site yet."));
    }
    const content = this.curveContent(ours, theirs);
    if (this.chart) return this.chart.set(content);
    replace(this.curveBox);
    this.chart = new Chart(this.curveBox, content, 260);
  }

  curveContent(ours, theirs) {
    const against = ours[this.against] ? this.against : "time_s";
    const x = ours[against];
    const y = ours.displacement_measured_mm ? { title: "Displacement", unit: "mm" } : { title: "Force", unit: "N" };
    const of = (kind, curves = ours) => curves?.[`${y.title.toLowerCase()}_${kind}_${y.unit}`];
    const one = (label, colour, y, more = {}) => ({ label, colour, x, y, ...more });
    const series = [
      one("measured", "--measured", of("measured"), { width: 3 }),
      one("one material", "--second", of("one_material"), { dash: "dashed" }),
      one("this run", "--simulated", of("simulated")),
    ].filter((line) => line.y);
    if (of("simulated", theirs)) series.push({ label: this.other, colour: "--third", dash: "dashdot", x: theirs[against], y: of("simulated", theirs) });
    if (this.time !== null && against === "time_s" && this.player.times.length > 1) {
      series.push({ label: "moment shown", colour: "--soft", width: 1, dash: "dotted", x: [this.time, this.time], y: [0, Math.max(...of("measured"))] });
    }
    const band = against === "time_s" && of("low") ? { label: "95 % interval", colour: "--simulated", x, low: of("low"), high: of("high") } : null;
    return { label: `${y.title} at site ${this.chosen}.`, x: AXES[against], y, series, band };
  }

  /** The moment that the player shows, as a line in the curves. */
  mark(time) {
    this.time = time;
    if (this.chart && this.curves?.ours && this.against === "time_s" && this.player.times.length > 1) this.chart.move(this.curveContent(this.curves.ours, this.curves.theirs));
  }

  showRuns() {
    const { kept } = this.outcome;
    replace(this.compareWith, el("option", { value: "" }, kept.length ? "no other run" : "no run is kept yet"),
      ...kept.map((run) => el("option", { value: run.name }, `${run.name} (${run.since.slice(0, 16).replace("T", " ")})`)));
    this.compareWith.value = this.other;
    this.drop.hidden = !this.other;
    const outside = this.outcome.outside.map((text) => el("p", { class: "hint doubt" }, `⚠ ${text}`));
    replace(this.compared, this.siteTable(), ...outside, this.parameterTable());
  }

  async compare(name) {
    this.other = name;
    await this.refresh();
  }

  async keep() {
    const name = this.keepName.value.trim();
    try {
      await this.context.api.post("results/keep", { name });
      this.keepName.value = "";
      this.context.say(`This run is kept as ${name}.`);
      await this.refresh();
    } catch (error) {
      this.context.warn(error.message);
    }
  }

  async dropKept() {
    try {
      await this.context.api.post("results/drop", { name: this.other });
      this.other = "";
      await this.refresh();
    } catch (error) {
      this.context.warn(error.message);
    }
  }

  siteTable() {
    const { sites, means } = this.outcome;
    if (!sites.length) return el("p", { class: "hint" }, "No predictions are stored yet: run the study (view Identification).");
    const other = new Map((this.beside?.sites ?? []).map((row) => [row.record, row]));
    const rows = sites.map((row) => [row.record, row.region, row.fitted ? "fitted" : "held out", shortNumber(row.peak_force_N),
      shortNumber(row.error_one_material_percent), shortNumber(row.error_percent), ...(this.beside ? [shortNumber(other.get(row.record)?.error_percent)] : [])]);
    const mean = (from, kind) => shortNumber(from?.[`mean_error_${kind}_percent`]);
    for (const [kind, text] of [["fitted", "mean, fitted"], ["heldout", "mean, held out"]]) {
      rows.push([text, "", "", "", "", mean(means, kind), ...(this.beside ? [mean(this.beside.means, kind)] : [])]);
    }
    return table(["site", "region", "use", "largest force (N)", "error, one material (%)", "error (%)", ...(this.beside ? [`error, ${this.other} (%)`] : [])], rows, "Error of each site, of the largest measured value (of the force, or of the displacement under a stated force)");
  }

  parameterTable() {
    const { stages, intervals_95: intervals, verdict } = this.outcome;
    const last = stages.at(-1);
    if (!last) return null;
    const theirs = this.beside?.stages.at(-1)?.parameters ?? {};
    const rows = Object.entries(last.parameters).flatMap(([tissue, values]) => Object.keys(values).map((key) => {
      const [symbol, unit] = parted(key);
      const limits = intervals[tissue]?.[key];
      return [`${tissue} ${symbol} (${unit})`, shortNumber(stages[0].parameters[tissue]?.[key]), shortNumber(values[key]), limits ? `${shortNumber(limits[0])} to ${shortNumber(limits[1])}` : "–",
        verdict[`${tissue}.${key}`] ?? "–", ...(this.beside ? [shortNumber(theirs[tissue]?.[key])] : [])];
    }));
    return table(["parameter", stages[0].name, last.name, "95 % interval", "verdict", ...(this.beside ? [this.other] : [])], rows, "Identified parameters");
  }
}
