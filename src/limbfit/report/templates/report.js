// What the figures of the report do: each holds its data as JSON and becomes a picture to turn or curves to read.
const VIEWS = [["anterior", 0], ["left", Math.PI / 2], ["posterior", Math.PI], ["right", -Math.PI / 2]];
const AGAINST = { time_s: { title: "Time", unit: "s" }, displacement_mm: { title: "Displacement", unit: "mm" } };
const FORCE = { title: "Force", unit: "N" };
const LINES = [["--simulated", "solid"], ["--one-material", "dashed"], ["--third", "dashdot"], ["--ink", "dotted"]];

function choice(label, options, changed) {
  const list = element("select", { onchange: () => changed(list.value) },
    ...options.map(([value, text]) => element("option", { value, textContent: text })));
  return { part: element("label", {}, label, " ", list), list };
}

function againstChoice(changed) {
  return choice("against", [["time_s", "time (s)"], ["displacement_mm", "displacement (mm)"]], changed);
}

/** The curves of one site for a chart. */
function forceCurves(curves, site, chosen) {
  const against = curves[chosen] ? chosen : "time_s";
  const x = curves[against];
  if (curves.displacement_measured_mm) return depthCurves(curves, site, against);
  const one = (label, column, colour, more) => ({ label, colour, x, y: curves[column], ...more });
  const found = [
    one("measured", "force_measured_N", "--measured", { width: 3 }),
    one("one material", "force_one_material_N", "--one-material", { dash: "dashed" }),
    one(curves.materials, "force_simulated_N", "--simulated", {}),
    one(curves.stage === "traces" ? "measured" : "simulated", "force_N", "--simulated", {}),
  ].filter((series) => series.y);
  const band = curves.force_low_N && against === "time_s"
    ? { label: "95 % interval", colour: "--simulated", x, low: curves.force_low_N, high: curves.force_high_N } : null;
  return { label: `Force at site ${curves.record ?? site}.`, x: AGAINST[against], y: FORCE, series: found, band };
}

/** The same of a record under a stated force, whose depths are compared. */
function depthCurves(curves, site, against) {
  const x = curves[against];
  const one = (label, kind, colour, more) => ({ label, colour, x, y: curves[`displacement_${kind}_mm`], ...more });
  const series = [one("measured", "measured", "--measured", { width: 3 }), one("one material", "one_material", "--one-material", { dash: "dashed" }),
    one(curves.materials, "simulated", "--simulated", {})].filter((line) => line.y);
  const band = curves.displacement_low_mm ? { label: "95 % interval", colour: "--simulated", x, low: curves.displacement_low_mm, high: curves.displacement_high_mm } : null;
  return { label: `Displacement at site ${curves.record ?? site}.`, x: AGAINST[against], y: AGAINST.displacement_mm, series, band };
}

class Explorer {
  constructor(figure, content) {
    this.curves = content.curves;
    const { arrays, facts } = readArrays(bytesOfBase64(content.arrays));
    Object.assign(this, { arrays, facts, against: "time_s", site: null });
    this.fields = new Map(facts.fields.map((field) => [field.site, field]));
    this.stage = element("div", { className: "explorer-stage" });
    this.chartBox = element("div", {});
    this.side = element("div", { className: "explorer-side" });
    figure.prepend(element("div", { className: "explorer" }, this.stage, this.side));
    this.viewer = new Viewer(this.stage, figure.dataset.label);
    this.buildControls();
    this.buildSurfaces();
    this.choose(facts.sites[0]?.name ?? null, false);
    this.viewer.lookAtAll(facts.frame);
    this.viewer.onSite = (name) => this.choose(name, true);
  }

  buildControls() {
    const { sites, surfaces } = this.facts;
    const named = sites.map((site) => [site.name, [site.name, site.region, site.fitted ? "fitted" : "held out"].filter(Boolean).join(", ")]);
    this.picker = choice("Site", named, (name) => this.choose(name, true));
    const kinds = [...new Set(surfaces.map((surface) => surface.kind))];
    this.boxes = kinds.map((kind) => {
      const box = element("input", { type: "checkbox", checked: kind !== "layer", onchange: () => this.showSurfaces() });
      return { kind, box, part: element("label", {}, box, ` ${{ skin: "skin", bone: "bones", layer: "layers" }[kind]}`) };
    });
    this.field = choice("Show", [["", "the limb"], ["stress", "von Mises stress"], ["size", "displacement"]], () => this.showField());
    this.warp = element("input", { type: "range", min: 0, max: 1, step: 0.05, value: 1, oninput: () => this.viewer.setStyle({ warp: Number(this.warp.value) }) });
    this.warpPart = element("label", {}, "deformation ", this.warp);
    const views = VIEWS.map(([name, azimuth]) =>
      element("button", { type: "button", textContent: name, onclick: () => { this.field.list.value = ""; this.showField(); this.viewer.view.side(azimuth); } }));
    const axis = againstChoice((value) => { this.against = value; this.showCurves(); });
    this.words = element("p", { className: "explorer-words" });
    this.side.append(
      element("div", { className: "controls" }, this.picker.part, this.field.part, this.warpPart),
      element("div", { className: "controls" }, ...this.boxes.map(({ part }) => part)),
      element("div", { className: "controls", role: "group", ariaLabel: "Side of the limb" }, ...views),
      this.words, element("div", { className: "controls" }, "Force ", axis.part), this.chartBox);
    this.picker.part.hidden = !sites.length;
  }

  buildSurfaces() {
    for (const surface of this.facts.surfaces) {
      const [points, faces] = ["points", "faces"].map((part) => this.arrays[`${surface.name}.${part}`].values);
      this.viewer.setSurface(surface.name, { points, faces, colour: surface.colour, opacity: surface.opacity });
    }
    this.showSurfaces();
  }

  showSurfaces() {
    const shown = new Map(this.boxes.map(({ kind, box }) => [kind, box.checked]));
    const whole = !this.shownField();
    for (const surface of this.facts.surfaces) this.viewer.showSurface(surface.name, shown.get(surface.kind) && whole);
  }

  shownField() {
    return this.field.list.value && this.fields.get(this.site);
  }

  choose(name, asked) {
    if (name === null) return;
    this.site = this.picker.list.value = name;
    const known = this.fields.has(name);
    for (const option of [...this.field.list.options].slice(1)) option.disabled = !known;
    if (!known) this.field.list.value = "";
    this.viewer.setSites(this.facts.sites.map((site) => ({ ...site, filled: site.fitted, chosen: site.name === name })));
    const site = this.facts.sites.find((one) => one.name === name);
    const error = site.error_percent === null ? "" : ` Error of the ${site.compared} ${shortNumber(site.error_percent)} %.`;
    this.words.textContent = `Site ${name}${site.region ? `, ${site.region}` : ""}: ${site.fitted ? "fitted" : "held out"}.${error}` +
      (known ? "" : " No field is stored for it.");
    if (asked && !this.shownField()) this.viewer.view.lookAlong(site.axis);
    this.showField();
    this.showCurves();
  }

  showField() {
    const field = this.shownField();
    this.warpPart.hidden = !field;
    this.showSurfaces();
    this.viewer.showSites(!field);
    if (!field) {
      this.viewer.setMesh(null);
      this.viewer.setColours(null);
      if (this.wasField) this.viewer.view.reset();
      this.wasField = false;
      return;
    }
    const part = (name) => this.arrays[`${field.name}.${name}`].values;
    const [points, faces, moved, stress] = ["points", "faces", "moved", "stress"].map(part);
    const owners = Uint32Array.from({ length: stress.length }, (_, i) => i);
    const mesh = { points, faces, owners, neighbours: new Int32Array(owners.length).fill(-1), regions: new Uint8Array(owners.length), cells: new Uint32Array(0) };
    this.viewer.setMesh(mesh, ["#888888"]);
    const byStress = this.field.list.value === "stress";
    const values = byStress ? stress : sizesOf(moved);
    this.viewer.setMoment({ on: byStress ? "cells" : "nodes", values }, moved);
    const [low, high] = [0.01, 0.99].map((share) => quantile(values, share));
    this.viewer.setColours({ map: "viridis", low, high, title: byStress ? "von Mises stress (kPa)" : "displacement (mm)" });
    this.viewer.setStyle({ edged: false, warp: Number(this.warp.value) });
    const site = this.facts.sites.find((one) => one.name === this.site);
    Object.assign(this.viewer.view, { target: site.at.map((value, k) => value + 14 * site.axis[k]), half: 40 });
    this.viewer.view.lookAlong(field.direction);
    this.wasField = true;
  }

  showCurves() {
    const curves = this.curves[this.site];
    this.chartBox.hidden = !curves;
    if (!curves) return;
    const content = forceCurves(curves, this.site, this.against);
    if (this.chart) this.chart.set(content);
    else this.chart = new Chart(this.chartBox, content, 260);
  }
}

function sizesOf(vectors) {
  return Float32Array.from({ length: vectors.length / 3 }, (_, i) => Math.hypot(vectors[3 * i], vectors[3 * i + 1], vectors[3 * i + 2]));
}

function quantile(values, share) {
  const sorted = Float32Array.from(values).sort();
  return sorted[Math.min(sorted.length - 1, Math.floor(share * sorted.length))];
}

/** Records: a site and an axis to choose, raw and regularised curves; touch-down and ends of phases as lines. */
function showRecords(figure, { sites }) {
  const names = Object.keys(sites);
  const now = { site: names[0], against: "time_s" };
  const box = element("div", {});
  const content = () => {
    const { raw, smooth, touch, ends } = sites[now.site], { against } = now;
    const forces = [...raw.force_N, ...smooth.force_N].filter((value) => value !== null);
    const low = Math.min(0, ...forces), high = Math.max(...forces);
    const series = [
      { label: "as recorded", colour: "--muted", width: 1.2, x: raw[against], y: raw.force_N },
      { label: "regularised", colour: "--simulated", x: smooth[against], y: smooth.force_N },
      { label: "touch-down", colour: "--ink", dash: "dashed", width: 1.2, x: [touch[against], touch[against]], y: [low, high] },
      { label: "phases", colour: "--muted", dash: "dotted", width: 1, x: ends[against].flatMap((at) => [at, at, null]), y: ends[against].flatMap(() => [low, high, null]) },
    ];
    return { label: `Record of site ${now.site}.`, x: AGAINST[against], y: FORCE, series };
  };
  const update = (change) => { Object.assign(now, change); chart.set(content()); };
  const site = choice("Site", names.map((name) => [name, name]), (value) => update({ site: value }));
  const axis = againstChoice((value) => update({ against: value }));
  figure.prepend(element("div", { className: "controls" }, site.part, "Force ", axis.part), box);
  const chart = new Chart(box, content(), 280);
}

/** Iterates: the error or one of the parameters to choose. */
function showIterates(figure, { panels }) {
  const box = element("div", {});
  const content = (at) => {
    const panel = panels[at];
    const series = panel.series.map((one, k) => {
      const [colour, dash] = panel.log && k ? ["--muted", "solid"] : LINES[(panel.log ? 3 : k) % LINES.length];
      return { ...one, colour, dash: dash === "solid" || panel.log ? undefined : dash, width: panel.log && k ? 1 : 2, points: !panel.log || !k, x: one.y.map((_, i) => i) };
    });
    return { label: `${panel.title} over the iterates.`, x: { title: "Iterate", unit: "" }, y: { title: panel.title, unit: panel.unit, log: panel.log }, series };
  };
  const pick = choice("Show", panels.map((panel, i) => [i, `${panel.title} (${panel.unit})`]), (at) => chart.set(content(Number(at))));
  figure.prepend(element("div", { className: "controls" }, pick.part), box);
  const chart = new Chart(box, content(0), 280);
}

const SHOW = { model: (figure, content) => new Explorer(figure, content), records: showRecords, iterates: showIterates };

for (const figure of document.querySelectorAll("figure.interactive")) {
  const content = JSON.parse(figure.querySelector("script").textContent);
  if (figure.dataset.what === "model" && !canDraw()) {
    figure.replaceChildren(element("p", { className: "note", role: "note",
      textContent: "This browser does not draw in three dimensions (no WebGL 2): the pictures below show the same." }));
  } else SHOW[figure.dataset.what](figure, content);
  figure.hidden = false;
}
