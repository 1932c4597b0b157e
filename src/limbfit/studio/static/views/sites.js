// The sites of the study in the view Model: a list, and changes that are written into the study file.
import { el, replace } from "/static/dom.js";
import { labelled } from "/static/views/parts.js";

const DEPTH_MM = 8;

export class SiteEditor {
  /** view: has scene, chosen, choose(name, turn), take(scene), marks(), context. */
  constructor(view) {
    Object.assign(this, { view, mode: null, draft: null });
    this.list = el("ul", { class: "plain site-list" });
    this.form = el("div", { class: "site-form" });
    this.part = el("div", {}, el("h2", {}, "Sites"), this.list,
      el("div", { class: "row" }, (this.adder = el("button", { type: "button", onclick: () => this.begin("add") }, "Add a site")),
        el("button", { type: "button", onclick: () => this.send("model/markers", { depth_mm: DEPTH_MM }, "Each marker has a site.") }, "Take the markers")), this.form);
  }

  show() {
    const { scene, chosen } = this.view;
    replace(this.list, ...scene.sites.map((site) => el("li", {},
      el("button", { type: "button", class: "quiet site", "aria-pressed": String(site.name === chosen), onclick: () => { this.end(); this.view.choose(site.name, true); } },
        el("span", { class: site.fitted ? "dot fitted" : "dot held-out", "aria-hidden": "true" }),
        el("strong", {}, site.name), el("span", { class: "region" }, site.region),
        el("span", { class: "hint" }, site.fitted ? "fitted" : site.has_trace ? "held out" : "planned")))));
    if (this.mode === "add") this.showNew();
    else this.showSite(scene.sites.find((site) => site.name === chosen));
  }

  begin(mode) {
    this.set(this.mode === mode ? null : mode);
    this.view.marks();
    this.show();
    if (this.mode) this.view.context.say("Click on the skin, or give coordinates.");
  }

  end() {
    this.set(null);
  }

  set(mode) {
    Object.assign(this, { mode, draft: null });
    if (this.view.viewer) this.view.viewer.placing = mode !== null;
  }

  /** A click on the skin. */
  placed(point) {
    if (!this.mode) return;
    this.draft = point;
    this.view.marks();
    this.show();
    this.form.querySelector(this.mode === "add" ? "input[name=name]" : "button.main")?.focus();
  }

  coordinates() {
    const given = this.draft ?? (this.mode === "move" ? this.view.site()?.position_mm : null) ?? [null, null, null];
    const inputs = ["x", "y", "z"].map((name, k) => el("input", {
      type: "number", step: "0.01", name, "aria-label": `${name} (mm, LPS)`, value: given[k] === null ? "" : given[k].toFixed(2),
      onchange: () => {
        const values = inputs.map((input) => Number.parseFloat(input.value));
        if (values.every(Number.isFinite)) { this.draft = values; this.view.marks(); }
      },
    }));
    return el("div", { class: "coordinates" }, el("span", { class: "hint" }, "place, x y z (mm, LPS)"), el("div", { class: "row" }, inputs));
  }

  showNew() {
    const name = el("input", { name: "name", maxlength: "40", value: this.typed?.name ?? this.nextName() });
    const region = el("input", { name: "region", maxlength: "200", value: this.typed?.region ?? "" });
    const depth = el("input", { name: "depth", type: "number", min: "0.5", max: "100", step: "0.5", value: DEPTH_MM });
    const remember = () => { this.typed = { name: name.value, region: region.value }; };
    name.addEventListener("input", remember);
    region.addEventListener("input", remember);
    const save = async (event) => {
      event.preventDefault();
      if (!this.draft) return this.view.context.say("Click on the skin, or give coordinates, to say where the site is.");
      const site = { name: name.value.trim(), region: region.value.trim(), depth_mm: Number(depth.value), position: this.draft };
      if (await this.send("model/sites", site, `Site ${site.name} is in the study.`)) {
        this.typed = null;
        this.view.choose(site.name);
      }
    };
    replace(this.form, el("form", { onsubmit: save }, el("h3", {}, "New site"),
      el("p", { class: "hint" }, this.draft ? "Name it and save it." : "Click on the skin where the site is."),
      this.coordinates(), labelled("name", name), labelled("region", region), labelled("depth (mm) to simulate", depth),
      el("div", { class: "row" }, el("button", { type: "submit", class: "main" }, "Save"), this.cancel())));
  }

  cancel() {
    return el("button", { type: "button", onclick: () => { this.end(); this.view.marks(); this.show(); } }, "Cancel");
  }

  nextName() {
    const taken = new Set(this.view.scene.sites.map((site) => site.name));
    let i = taken.size + 1;
    while (taken.has(String(i)) || taken.has(String(i).padStart(2, "0"))) i++;
    const wide = [...taken].every((name) => /^\d\d$/.test(name));
    return wide ? String(i).padStart(2, "0") : String(i);
  }

  showSite(site) {
    if (!site) return replace(this.form);
    const path = `model/sites/${encodeURIComponent(site.name)}`;
    const change = (values, text) => this.send(path, values, text);
    const name = el("input", { name: "name", maxlength: "40", value: site.name, onchange: async () => {
      const wanted = name.value.trim();
      if (await change({ name: wanted }, `Site ${site.name} is now ${wanted}.`)) this.view.choose(wanted);
      else name.value = site.name;
    } });
    const region = el("input", { name: "region", maxlength: "200", value: site.region, onchange: () => change({ region: region.value.trim() }, `Region of site ${site.name} saved.`) });
    const fitted = el("input", { type: "checkbox", checked: site.fitted, disabled: !site.has_trace, onchange: async () => {
      if (!(await change({ fitted: fitted.checked }, `Site ${site.name} is ${fitted.checked ? "fitted" : "held out"}.`))) fitted.checked = site.fitted;
    } });
    replace(this.form, el("h3", {}, `Site ${site.name}`),
      labelled("name", name), labelled("region", region),
      el("label", { class: "row" }, fitted, site.has_trace ? "fitted (otherwise held out)" : "no record: it can be simulated, not fitted"),
      ...this.facts(site).map((text) => el("p", { class: "hint" }, text)),
      site.problem ? el("p", { class: "doubt" }, site.problem) : null,
      ...(this.mode === "move" ? this.moving(site, change) : [el("div", { class: "row" },
        el("button", { type: "button", onclick: () => this.begin("move") }, "Move"), this.remover(site, path))]));
  }

  facts(site) {
    const list = (values, digits) => values.map((value) => value.toFixed(digits).replace("-", "−")).join(", ");
    const rows = site.position_mm ? [`place ${list(site.position_mm, 1)} mm (LPS)`, `axis into the limb ${list(site.axis, 2)}`] : [];
    if (site.given === "near") rows.push("placed by its marker; moving it fixes its place");
    if (site.off_skin_mm > 0.05) rows.push(`given ${site.off_skin_mm.toFixed(1)} mm off the skin`);
    return rows;
  }

  moving(site, change) {
    const save = async () => {
      if (!this.draft) return this.view.context.say("Click on the skin, or give coordinates, to say where it goes.");
      const position = this.draft;
      if (await change({ position }, `Site ${site.name} has moved.`)) this.view.marks();
    };
    return [el("p", { class: "hint" }, this.draft ? "Save the new place." : "Click on the skin where the site goes."), this.coordinates(),
      el("div", { class: "row" }, el("button", { type: "button", class: "main", onclick: save }, "Save place"), this.cancel())];
  }

  /** Asks once more in place, so that no dialogue covers the limb. */
  remover(site, path) {
    const button = el("button", { type: "button", onclick: () => {
      if (button.dataset.sure) return this.send(`${path}/remove`, {}, `Site ${site.name} is no longer in the study; its record stays.`);
      button.dataset.sure = "yes";
      button.textContent = `Remove ${site.name}?`;
      setTimeout(() => { delete button.dataset.sure; button.textContent = "Remove"; }, 5000);
    } }, "Remove");
    return button;
  }

  /** Change the study file; true where the server did. */
  async send(path, values, text) {
    try {
      const scene = await this.view.context.api.post(path, values);
      this.end();
      await this.view.take(scene);
      this.view.context.say(text);
      this.view.context.refresh();
      return true;
    } catch (error) {
      this.view.context.warn(error.message);
      return false;
    }
  }
}
