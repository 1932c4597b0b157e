// The view Identification: runs started, stopped and watched; the search as it converges; what came out.
import { el, replace, table } from "/static/dom.js";
import { Chart } from "/web/chart.js";
import { shortNumber } from "/web/colours.js";

// A parameter's name and unit from its key.
const parted = (key) => { const found = /^(.*)_(kPa|s)$/.exec(key); return found ? [found[1], found[2]] : [key, ""]; };
const LOOKS = [["--second", "solid"], ["--simulated", "dashed"], ["--third", "dashdot"], ["--measured", "dotted"]];
const ENDS = { running: "goes on", ended: "ended well" };
const STATES = { done: "done", stale: "stale", begun: "begun", missing: "not done" };

export function mount(element, context) {
  const view = new IdentificationView(element, context);
  view.refresh();
  context.on((changed) => (changed.study || changed.stages || changed.log || changed.run) && view.refresh());
  context.on((changed) => changed.theme && view.charts.forEach((chart) => chart.draw()));
  return { show: () => view.refresh() };
}

class IdentificationView {
  constructor(element, context) {
    Object.assign(this, { element, context });
    this.parts = new Map();
    this.site = null;
    element.classList.add("split");
    this.area = el("div", { class: "stagearea padded" });
    element.append(this.sidebar(), this.area);
    this.build();
  }

  get charts() {
    return [...this.parts.values()].filter(Boolean);
  }

  sidebar() {
    this.start = el("button", { type: "button", class: "main", id: "run-start", onclick: () => this.run({}) }, "Run what is missing");
    this.runAll = el("button", { type: "button", class: "main", onclick: () => this.run({}) }, "Run the study");
    this.stop = el("button", { type: "button", id: "run-stop", onclick: () => this.halt() }, "Stop");
    this.until = el("select", { id: "run-until" });
    this.state = el("p", { id: "run-state", role: "status" });
    this.meter = el("progress", { id: "run-meter", "aria-label": "Progress of the stage", max: 1 });
    this.stages = el("div", {});
    this.log = el("ol", { class: "plain log", id: "run-log", tabindex: 0, "aria-label": "Log of the run" });
    return el("div", { class: "side" }, el("h2", {}, "Run"),
      el("div", { class: "field" }, el("label", { for: "run-until" }, "Stop after"), this.until),
      el("div", { class: "row" }, this.start, this.stop), this.state, this.meter, this.stages,
      el("details", {}, el("summary", {}, "Log"), this.log),
      el("p", { class: "hint" }, "A run continues when this page or its server is closed. A stopped run continues where it stopped."));
  }

  build() {
    const card = (id, title, ...more) => el("section", { class: "card", id, "aria-label": title }, el("h2", {}, title), more);
    this.errorHost = el("div", {});
    this.parameterHost = el("div", { class: "small" });
    this.errorNote = el("p", { class: "hint", id: "convergence-note" });
    this.pick = el("select", { id: "curve-site", onchange: () => this.curves((this.site = this.pick.value)) });
    this.curveHost = el("div", {});
    this.curveNote = el("p", { class: "hint" });
    this.answer = el("div", {});
    replace(this.area, el("div", { class: "two" },
      card("convergence", "How the search goes", this.errorNote, this.errorHost),
      card("curves", "Measured and simulated", el("div", { class: "row" }, el("label", { for: "curve-site" }, "Site"), this.pick), this.curveNote, this.curveHost)),
    card("parameters", "Parameters", this.parameterHost),
    card("answer", "What came out", this.answer));
  }

  async refresh() {
    if (this.busy) {
      this.again = true;
      return;
    }
    this.busy = true;
    await this.context.load(this.element, "the search and what came out", () => this.read());
    this.busy = false;
    if (this.again) {
      this.again = false;
      this.refresh();
    }
  }

  async read() {
    this.found = await this.context.api.get("identification");
    this.tellRun();
    this.convergence();
    this.results();
    this.sites();
    const { answer, iterates, run, starting } = this.found;
    if (answer || iterates.rows.length) return;
    if (run || starting) return { text: "The study is running. Its search appears here once it has begun." };
    return { text: "Nothing is identified yet: the stages until calibrate search the parameters of the tissues.", actions: [this.runAll] };
  }

  // --- the run --------------------------------------------------------------------------------------------

  async run(wanted) {
    this.start.disabled = true;
    try {
      const until = this.until.value;
      const { process } = await this.context.api.post("identification/start", { ...(until && { until }), ...wanted });
      this.context.say(`Started as process ${process}.`);
    } catch (error) {
      this.context.warn(error.message);
    }
    this.context.refresh();
    this.refresh();
  }

  async halt() {
    this.stop.disabled = true;
    try {
      const { process } = await this.context.api.post("identification/stop");
      this.context.say(`Process ${process} was asked to stop; it does within seconds. What is finished is kept.`);
    } catch (error) {
      this.context.warn(error.message);
    }
    this.refresh();
  }

  tellRun() {
    const { run, last, stages, chain } = this.found;
    const starting = Boolean(this.found.starting);
    this.start.disabled = Boolean(run) || starting;
    this.stop.disabled = !run && !starting;
    clearTimeout(this.soon);
    if (starting) this.soon = setTimeout(() => this.refresh(), 1500);
    const begun = stages.some((row) => row.state === "begun");
    this.start.textContent = begun && !run ? "Resume" : "Run what is missing";
    const now = last?.now;
    const ended = last ? `The last run${last.what === "run" ? "" : ` (limbfit ${last.what})`} ${ENDS[last.state] ?? last.state}${last.error ? `: ${last.error}` : "."}` : "Nothing was run yet.";
    const next = stages.find((row) => chain.includes(row.stage) && row.state !== "done");
    const then = next ? `Next: ${next.stage}${next.state === "stale" ? ", which is stale" : ""}.` : "All stages are done: there is nothing to run.";
    this.state.textContent = starting ? "Starting …" : run && now ? `${now.stage}: ${now.text}` : run ? "Running" : `${ended} ${then}`;
    this.state.className = !run && last?.error ? "bad" : "";
    this.meter.hidden = !run;
    if (run && now?.total) this.meter.value = Math.min(now.done / now.total, 1);
    else this.meter.removeAttribute("value");
    const chosen = this.until.value;
    if (this.until.childElementCount !== chain.length) {
      replace(this.until, el("option", { value: "" }, "the report"), chain.slice(0, -1).map((name) => el("option", { value: name }, name)));
      this.until.value = chosen;
    }
    this.stageTable(stages, Boolean(run) || starting);
    replace(this.log, (last?.lines ?? []).slice(-30).map((row) => el("li", {}, `${row.seconds.toFixed(0)} s ${row.stage}: ${row.text}`)));
  }

  stageTable(stages, busy) {
    const focused = document.activeElement?.dataset?.anew;
    const rows = stages.map((row) => [row.stage, el("span", { class: { done: "good", stale: "doubt", begun: "doubt" }[row.state] ?? "" }, STATES[row.state] ?? row.state),
      row.seconds === null ? "" : `${row.seconds.toFixed(row.seconds < 100 ? 1 : 0)} s`,
      row.state === "missing" || !this.found.chain.includes(row.stage) ? "" : el("button", { type: "button", class: "tiny", "data-anew": row.stage, disabled: busy, title: `Do ${row.stage} and all after it once more`,
        "aria-label": `Redo ${row.stage} and all after it`, onclick: () => this.run({ start: row.stage }) }, "redo")]);
    const why = stages.filter((row) => row.why?.length).map((row) => el("li", {}, `${row.stage}: ${row.why.join("; ")}`));
    replace(this.stages, table(["Stage", "State", "Time", ""], rows), why.length ? el("details", {}, el("summary", {}, "Why stale"), el("ul", { class: "hint" }, why)) : null);
    if (focused) this.stages.querySelector(`[data-anew="${focused}"]`)?.focus();
  }

  // --- convergence ----------------------------------------------------------------------------------------

  plot(key, host, content, height) {
    const known = this.parts.get(key);
    const mark = JSON.stringify(content);
    if (known?.mark === mark) return;
    if (known) known.set(content);
    else this.parts.set(key, new Chart(host, content, height));
    this.parts.get(key).mark = mark;
  }

  convergence() {
    const { rows, of } = this.found.iterates;
    const last = rows.at(-1), forced = this.found.sites.filter((row) => row.fitted).map((row) => row.forced);
    const quantity = !forced.includes(true) ? "force" : forced.includes(false) ? "force or displacement" : "displacement";
    this.errorNote.textContent = !last ? "No search yet." :
      `${of === "log" ? "As the log tells it: " : ""}${last.of}, ${rows.length} iterates, mean error ${last.error_percent.toFixed(2)} % of the largest ${quantity}.`;
    if (!last) return;
    const x = rows.map((_, i) => i);
    const sites = Object.keys(last.error_percent_by_site).sort((a, b) => a.localeCompare(b, "en", { numeric: true }));
    const many = sites.length > 6;
    const series = [{ label: "mean of the fitted sites", colour: "--simulated", width: 3, points: true, x, y: rows.map((row) => row.error_percent) },
      ...sites.map((site, i) => ({ label: many ? "" : `site ${site}`, colour: many ? "--muted" : LOOKS[(i + 1) % 4][0], dash: ["dashed", "dotted", "dashdot"][i % 3], width: 1.2,
        x, y: rows.map((row) => row.error_percent_by_site[site]) }))];
    this.plot("error", this.errorHost, { label: `Error of the ${quantity} at the fitted sites over the iterates.`, x: { title: "Iterate", unit: "" },
      y: { title: `Error of the ${quantity}`, unit: "%", log: true }, series }, 250);
    this.parameters(rows, x);
  }

  parameters(rows, x) {
    // Those of the search itself: the study may have another law or other tissues by now.
    const found = rows.at(-1).parameters, tissues = Object.keys(found), parameters = Object.keys(found[tissues[0]] ?? {});
    if (this.parameterHost.childElementCount !== parameters.length) replace(this.parameterHost, parameters.map(() => el("div", {})));
    parameters.forEach((name, k) => {
      const [symbol, unit] = parted(name);
      const series = tissues.map((tissue, i) => ({ label: tissue, colour: LOOKS[i % 4][0], dash: LOOKS[i % 4][1], width: 2, points: true, x, y: rows.map((row) => row.parameters[tissue]?.[name] ?? null) }));
      this.plot(`parameter ${name}`, this.parameterHost.children[k], { label: `${symbol} over the iterates.`, x: { title: "Iterate", unit: "" }, y: { title: symbol, unit }, series }, 190);
    });
  }

  // --- curves ---------------------------------------------------------------------------------------------

  sites() {
    const { sites } = this.found;
    const mark = JSON.stringify(sites);
    if (this.pick.dataset.mark !== mark) {
      replace(this.pick, sites.map((row) => el("option", { value: row.site }, `${row.site} (${row.fitted ? "fitted" : "held out"})`)));
      this.pick.dataset.mark = mark;
    }
    if (!sites.some((row) => row.site === this.site)) this.site = (sites.find((row) => row.fitted) ?? sites[0])?.site ?? null;
    if (this.site === null) return;
    this.pick.value = this.site;
    this.curves(this.site);
  }

  async curves(name) {
    let found;
    try {
      found = await this.context.api.get(`identification/curves/${encodeURIComponent(name)}`);
    } catch (error) {
      this.context.warn(error.message);
      return;
    }
    if (name !== this.site) return;
    if (!found.of) {
      this.curveNote.textContent = "Nothing is simulated at this site yet.";
      this.parts.get("curves")?.close();
      this.parts.delete("curves");
      return;
    }
    this.curveNote.textContent = `Simulated: ${found.of}.`;
    const { time_s: x, displacement_mm: depth } = found;
    const y = found.displacement_measured_mm ? { title: "Displacement", unit: "mm" } : { title: "Force", unit: "N" };
    const of = (kind) => found[`${y.title.toLowerCase()}_${kind}_${y.unit}`];
    const series = [{ label: "measured", colour: "--measured", width: 2, x, y: of("measured") },
      { label: "simulated", colour: "--simulated", dash: "dashed", width: 2.5, x, y: of("simulated") }].filter((line) => line.y);
    if (of("one_material")) series.push({ label: "one material", colour: "--second", dash: "dotted", width: 1.5, x, y: of("one_material") });
    const band = of("low") ? { label: "95 %", colour: "--simulated", x, low: of("low"), high: of("high") } : undefined;
    this.plot("curves", this.curveHost, { label: `${y.title} at site ${name}, to ${Math.max(...(depth ?? of("measured"))).toFixed(1)} mm.`, x: { title: "Time from touch-down", unit: "s" },
      y, series, band }, 250);
  }

  // --- the answer -----------------------------------------------------------------------------------------

  results() {
    const { answer } = this.found;
    if (!answer) {
      replace(this.answer, el("p", {}, "Nothing is identified yet."));
      return;
    }
    if (this.answered === JSON.stringify(answer)) return;
    this.answered = JSON.stringify(answer);
    const rows = Object.entries(answer.parameters).flatMap(([tissue, values]) => Object.entries(values).map(([name, value]) => {
      const [low, high] = answer.intervals_95[tissue][name];
      const key = `${tissue}.${name}`;
      const verdict = answer.verdict[key];
      const [symbol, unit] = parted(name);
      return [`${tissue} ${symbol}${unit ? ` (${unit})` : ""}`, shortNumber(value), `${shortNumber(low)} to ${shortNumber(high)}`,
        el("span", { class: /^not/.test(verdict) ? "bad" : /weak/.test(verdict) ? "doubt" : "good" }, verdict), answer.at_bound[key] ? "at its bound" : ""];
    }));
    const stages = answer.stages.map((stage) => el("li", {}, `${stage.name}: ${stage.converged ? "converged" : "stopped"} after ${stage.evaluations} evaluations, ${stage.reason}`));
    const stale = answer.state === "done" ? null : el("p", { class: "doubt" }, "↻ This is the answer of the last calibration that was completed; its inputs have changed since.");
    const warnings = Object.entries(answer.warnings).flatMap(([site, texts]) => texts.map((text) => el("li", { class: "doubt" }, `⚠ site ${site}: ${text}`)));
    replace(this.answer, stale, el("div", { class: "fit" },
      el("div", {}, table(["Parameter", "Value", "95 % interval", "Verdict", ""], rows, "Identified parameters"), el("ul", { class: "hint" }, stages, warnings)),
      el("div", {}, this.correlation(answer.correlation))),
    el("h3", {}, "Combinations, best determined first"), el("ul", { class: "hint" }, answer.combinations.map((text) => el("li", {}, text))));
  }

  correlation({ names, matrix }) {
    const short = (name) => {
      const [tissue, parameter] = name.split(".");
      return `${tissue} ${parted(parameter ?? "")[0]}`;
    };
    const cell = (value) => {
      const made = el("span", { class: "heat" }, value.toFixed(2).replace("-", "−"));
      const share = Math.round(Math.min(Math.abs(value), 1) * 45);
      made.style.background = `color-mix(in srgb, ${value > 0 ? "var(--simulated)" : "var(--second)"} ${share}%, var(--paper))`;
      return made;
    };
    const made = table(["", ...names.map(short)], names.map((name, i) => [short(name), ...matrix[i].map(cell)]), "Correlation of the parameters");
    made.classList.add("correlation");
    return el("div", { class: "wide", tabindex: 0, role: "region", "aria-label": "Correlation of the parameters" }, made);
  }
}
