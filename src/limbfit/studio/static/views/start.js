// The view Start, of a folder without a study: files are dropped, images or surfaces chosen, a study file is written.
import { el, replace } from "/static/dom.js";
import { labelled } from "/static/views/parts.js";

const PART_BYTES = 8 << 20;

export function mount(element, context) {
  const view = new StartView(element, context);
  view.refresh();
  return { show: () => view.refresh() };
}

/** Copy a file into the folder of the study, in parts; returns its path there. */
export async function upload(context, file, path) {
  let answer = null;
  for (let offset = 0; offset < file.size; offset += PART_BYTES) {
    const body = await file.slice(offset, offset + PART_BYTES).arrayBuffer();
    answer = await context.api.send(`start/files/${path.split("/").map(encodeURIComponent).join("/")}?offset=${offset}`, body);
  }
  return answer?.path;
}

/** Files of a drop, with their paths, folders included. */
async function listDropped(transfer) {
  const found = [];
  const read = async (entry, before) => {
    const path = before + entry.name;
    if (entry.isFile) return found.push({ path, file: await new Promise((done, fail) => entry.file(done, fail)) });
    const reader = entry.createReader();
    for (let batch = null; batch === null || batch.length;) {
      batch = await new Promise((done, fail) => reader.readEntries(done, fail));
      for (const one of batch) await read(one, `${path}/`);
    }
  };
  for (const entry of [...transfer.items].map((item) => item.webkitGetAsEntry()).filter(Boolean)) await read(entry, "");
  return found;
}

class StartView {
  constructor(element, context) {
    Object.assign(this, { element, context, found: null });
    const listen = (input) => async () => this.take([...input.files].map((file) => ({ path: file.webkitRelativePath || file.name, file })));
    const folder = el("input", { type: "file", id: "start-folder", webkitdirectory: true, multiple: true });
    const files = el("input", { type: "file", id: "start-files", multiple: true });
    folder.addEventListener("change", listen(folder));
    files.addEventListener("change", listen(files));
    this.drop = el("div", { class: "card drop", id: "start-drop" },
      el("p", {}, "Drop a folder of DICOM images, surfaces or records here, or choose it. Files are copied into the study's folder on this machine, and go nowhere else."),
      el("div", { class: "row" }, el("label", { class: "field" }, "folder", folder), el("label", { class: "field" }, "files", files)),
      (this.progress = el("p", { class: "hint", role: "status" })));
    this.drop.addEventListener("dragover", (event) => { event.preventDefault(); this.drop.classList.add("over"); });
    this.drop.addEventListener("dragleave", () => this.drop.classList.remove("over"));
    this.drop.addEventListener("drop", async (event) => {
      event.preventDefault();
      this.drop.classList.remove("over");
      await this.take(await listDropped(event.dataTransfer));
    });
    this.form = el("form", { id: "start-form", onsubmit: (event) => this.write(event) });
    element.append(el("div", { class: "stagearea padded start" }, el("h2", {}, "A new study"), this.drop, this.form));
  }

  refresh() {
    return this.context.load(this.element, "the folder", async () => {
      const found = await this.context.api.get("start");
      if (JSON.stringify(found) === JSON.stringify(this.found)) return;
      this.found = found;
      this.show();
    });
  }

  async take(list) {
    let done = 0;
    try {
      for (const { path, file } of list) {
        if (file.size && !path.split("/").some((part) => part.startsWith("."))) await upload(this.context, file, path);
        this.progress.textContent = `${++done} of ${list.length} files are in the folder`;
      }
    } catch (error) {
      this.context.warn(error.message);
    }
    await this.refresh();
  }

  show() {
    const { images, surfaces, records, shapes } = this.found;
    const whole = images.filter((one) => one.whole !== false);
    const lines = [
      el("p", { class: "hint" }, `In the folder: ${count(images, "image")}, ${count(surfaces, "surface")}, ${count(records, "record")}. Records are given to sites under Traces.`),
      ...images.filter((one) => one.whole === false).map((one) => el("p", { class: "doubt" }, `${one.path}: ${one.why_not}`)),
    ];
    if (!whole.length && !surfaces.length) return replace(this.form, lines);
    const option = (one, i) => el("option", { value: String(i) }, describe(one));
    this.name = el("input", { name: "study", maxlength: "200", required: true, value: this.name?.value ?? this.context.study?.name ?? "" });
    this.image = el("select", { name: "image" }, el("option", { value: "" }, "none: the limb is given by surfaces"), ...whole.map(option));
    this.markers = el("select", { name: "markers" }, el("option", { value: "" }, "none: sites are placed on the skin"), el("option", { value: "same" }, "in the image itself"), ...whole.map(option));
    if (whole.length) this.image.value = "0";
    this.skin = el("select", { name: "skin" }, ...surfaces.map(option));
    this.unit = el("select", { name: "unit" }, ...["mm", "cm", "m", "inch"].map((unit) => el("option", {}, unit)));
    this.bones = surfaces.map((one) => el("input", { maxlength: "40", placeholder: "no bone", "aria-label": `name of the bone in ${one.path}`, name: `bone ${one.path}` }));
    this.shape = el("select", { name: "shape" }, ...shapes.map((one) => el("option", {}, one.name)));
    this.measures = el("div", {});
    this.shape.addEventListener("change", () => this.showMeasures());
    const geometry = () => { this.ofSurfaces.hidden = this.image.value !== ""; this.ofImage.hidden = this.image.value === ""; };
    this.image.addEventListener("change", geometry);
    this.ofImage = el("div", {}, labelled("markers on the skin", this.markers));
    this.ofSurfaces = el("div", {}, surfaces.length ? null : el("p", { class: "hint" }, "There is no closed surface in the folder (STL, PLY, OBJ, VTP, 3MF)."),
      labelled("skin", this.skin), labelled("unit of the files", this.unit), el("h3", {}, "Bones"),
      surfaces.map((one, i) => labelled(one.path, this.bones[i])));
    replace(this.form, lines,
      labelled("name of the study (no patient's name)", this.name),
      el("fieldset", {}, el("legend", {}, "Limb"), labelled("image", this.image), this.ofImage, this.ofSurfaces),
      el("fieldset", {}, el("legend", {}, "Indenter"), labelled("shape", this.shape), this.measures),
      el("div", { class: "row" }, el("button", { type: "submit", class: "main" }, "Write study.toml")));
    this.showMeasures();
    geometry();
  }

  showMeasures() {
    const { measures } = this.found.shapes.find((one) => one.name === this.shape.value);
    replace(this.measures, measures.map(([key, value]) => labelled(key.replace("_", " (").replace(/_/g, " ").replace(/$/, ")"), el("input", { type: "number", step: "any", name: key, value }))));
  }

  async write(event) {
    event.preventDefault();
    const { images, surfaces } = this.found;
    const whole = images.filter((one) => one.whole !== false), image = whole[this.image.value], markers = whole[this.markers.value];
    const indenter = { shape: this.shape.value };
    for (const input of this.measures.querySelectorAll("input")) indenter[input.name] = Number(input.value);
    const study = { name: this.name.value.trim(), indenter };
    if (image) {
      Object.assign(study, { image: image.path, series: series(images, image) });
      if (this.markers.value) Object.assign(study, { markers: markers?.path ?? "same", markers_series: markers ? series(images, markers) : null });
    } else {
      const bones = this.bones.map((input, i) => [input.value.trim(), surfaces[i].path]).filter(([name]) => name);
      Object.assign(study, { skin: surfaces[this.skin.value]?.path, unit: this.unit.value, bones: Object.fromEntries(bones) });
    }
    try {
      await this.context.api.post("start/study", study);
      await this.context.refresh();
      location.hash = image ? "#/image" : "#/model";
    } catch (error) {
      this.context.warn(error.message);
    }
  }
}

const count = (rows, noun) => `${rows.length} ${noun}${rows.length === 1 ? "" : "s"}`;

/** The series is stated where its folder holds several. */
const series = (images, one) => (images.filter((other) => other.path === one.path).length > 1 ? one.uid : null);

function describe(one) {
  if (!one.uid) return one.path;
  const size = one.spacing_mm ? `, ${one.columns} × ${one.rows} × ${one.slices}, ${one.spacing_mm.map((step) => step.toFixed(2)).join(" × ")} mm` : "";
  return `${one.path}${one.number ? `, series ${one.number}` : ""} (${one.modality}${size})`;
}
