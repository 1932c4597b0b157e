// The shell: tabs, stages, theme, and what every view is given.
//
// A view is a module `views/<name>.js` that exports
//   mount(element, context)   builds the view in `element`; returns { show(), hide() }, of which none is needed
// and is given
//   context.api.get(path), .post(path, body), .send(path, bytes), .bytes(path), .url(path)   paths below /api
//   context.study             the study as GET /api/study tells it; always the newest
//   context.stages, .run      rows of `limbfit status`, and the run that goes on or null
//   context.on(listener)      listener({ study, stages, labels, log, acquired, run, theme }), true for what changed;
//                             a hidden view is told of it when it is shown again
//   context.load(place, what, read)   reads what a place shows: see states.js
//   context.say(text)         a line at the bottom, read out too, while the view is seen;  context.warn(text) one that stays
//   context.refresh()         ask for changes at once
// A view builds itself and reads what it shows by `load`, which says in its place what is loading, missing or wrong.
// Nothing is kept here that is not in the study's files.
import { api, ApiError } from "/static/api.js";
import { el, replace } from "/static/dom.js";
import { load } from "/static/states.js";

const VIEWS = [
  ["image", "Image"],
  ["model", "Model"],
  ["traces", "Traces"],
  ["identification", "Identification"],
  ["results", "Results"],
  ["socket", "Socket"],
  ["start", "Start"], // of a folder without a study, which has no other view
];
const TOPICS = ["study", "stages", "labels", "log", "acquired"];
const EVERY_MS = 1000;
const mounted = new Map();
let seen = null;

const context = {
  api,
  study: null,
  stages: [],
  run: null,
  load: (place, what, read) => load(place, what, read, context.warn),
  say(text) {
    document.getElementById("status").textContent = text;
  },
  warn(text) {
    const notice = document.getElementById("notice");
    notice.hidden = !text;
    replace(notice, el("span", {}, text), el("button", { type: "button", class: "quiet", onclick: () => context.warn("") }, "Close"));
  },
  refresh: () => poll(true),
};

async function poll(now = false) {
  let found;
  try {
    found = await api.get("changes");
  } catch (error) {
    const lost = error instanceof ApiError && error.status === 401;
    offline(lost ? "This page belongs to a server that has ended: open the address that limbfit studio printed last." : "The server does not answer. Runs go on; start limbfit studio again to see them.");
    return;
  } finally {
    if (!now) setTimeout(poll, document.hidden ? 5 * EVERY_MS : EVERY_MS);
  }
  offline("");
  const run = JSON.stringify(found.run);
  const changed = Object.fromEntries(TOPICS.map((topic) => [topic, seen?.[topic] !== found[topic]]));
  changed.run = JSON.stringify(context.run) !== run;
  const first = seen === null;
  seen = found;
  context.run = found.run;
  if (first || TOPICS.some((topic) => changed[topic]) || changed.run) await tell(changed);
}

async function tell(changed) {
  try {
    if (changed.study || changed.acquired || context.study === null) context.study = await api.get("study");
    if (changed.study || changed.stages || changed.labels || changed.acquired || changed.run) {
      const found = await api.get("stages");
      [context.stages, context.run] = [found.stages, found.run];
    }
    if (context.broken) context.warn((context.broken = ""));
  } catch (error) {
    context.warn((context.broken = error.message));
    seen = null;
  }
  head();
  if (context.view && !isOpen(context.view)) route(); // the study has just been made
  tellViews(changed);
}

/** The view that is seen hears at once; for the others it is kept, so that nothing is read that nobody looks at. */
function tellViews(changed) {
  for (const one of mounted.values()) {
    for (const [topic, is] of Object.entries(changed)) one.missed[topic] ||= is;
    tellMissed(one);
  }
}

function tellMissed(one) {
  if (one.name !== context.view || !one.view) return;
  const { missed } = one;
  one.missed = {};
  if (Object.values(missed).some(Boolean)) for (const listener of one.listeners) listener(missed);
}

function offline(text) {
  document.body.classList.toggle("offline", text !== "");
  if (text) context.warn(text);
  else if (offline.said) context.warn("");
  offline.said = text;
}

const MARKS = { done: "✓", stale: "↻", begun: "…", missing: "○" };

function isOpen(key) {
  return (key === "start") === (context.study?.is_new ?? false);
}

function head() {
  for (const [key] of VIEWS) document.getElementById(`tab-${key}`).hidden = !isOpen(key);
  const name = context.study?.name ?? "";
  document.title = name ? `${name} – limbfit studio` : "limbfit studio";
  document.getElementById("study-name").textContent = name;
  const items = context.stages.map((row) =>
    el("span", { class: `stage ${row.state}`, title: [row.state, ...(row.why ?? [])].join("; ") },
      el("span", { class: "mark", "aria-hidden": "true" }, MARKS[row.state] ?? "?"),
      row.stage, el("span", { class: row.state === "stale" || row.state === "begun" ? "" : "hidden-text" }, `: ${row.state}`)));
  const run = context.run ? [el("span", { class: "stage running" }, `running (process ${context.run.process})`)] : [];
  replace(document.getElementById("strip"), ...items, ...run);
}

async function open(name) {
  const main = document.getElementById("view");
  const before = mounted.get(context.view);
  for (const [key] of VIEWS) {
    const tab = document.getElementById(`tab-${key}`);
    tab.setAttribute("aria-selected", String(key === name));
    tab.tabIndex = key === name ? 0 : -1;
  }
  if (context.view !== name) context.say(""); // what was said was of another view
  context.view = name;
  if (before && before.name !== name) {
    before.element.hidden = true;
    before.view?.hide?.();
  }
  const known = mounted.get(name);
  if (known) {
    known.element.hidden = false;
    known.view?.show?.();
    tellMissed(known);
    return;
  }
  const element = el("section", { class: `view ${name}`, role: "tabpanel", id: `panel-${name}`, "aria-labelledby": `tab-${name}` });
  main.append(element);
  const made = { name, element, listeners: new Set(), missed: {} };
  mounted.set(name, made);
  const own = Object.create(context, {
    on: { value: (listener) => made.listeners.add(listener) },
    say: { value: (text) => context.view === name && context.say(text) },
  });
  await context.load(element, "the view", async () => {
    const { mount } = await import(`/static/views/${name}.js`);
    made.view = mount(element, own);
    tellMissed(made);
  });
}

function route() {
  const name = location.hash.replace(/^#\/?/, "").split("/")[0];
  const known = VIEWS.some(([key]) => key === name && isOpen(key));
  if (context.study?.is_new) open("start");
  else open(known ? name : context.study?.has_image === false ? "traces" : "image");
}

function tabs() {
  const bar = document.getElementById("tabs");
  VIEWS.forEach(([key, title], i) => {
    bar.append(el("button", {
      type: "button", role: "tab", id: `tab-${key}`, "aria-controls": `panel-${key}`, "aria-selected": "false",
      title: `${title} (Alt+${i + 1})`, onclick: () => (location.hash = `#/${key}`),
    }, title));
  });
  const go = (i) => {
    const open = VIEWS.filter(([key]) => isOpen(key)), [key] = open[(i + open.length) % open.length];
    location.hash = `#/${key}`;
    document.getElementById(`tab-${key}`).focus();
  };
  bar.addEventListener("keydown", (event) => {
    const at = VIEWS.findIndex(([key]) => key === context.view);
    const to = { ArrowRight: at + 1, ArrowLeft: at - 1, Home: 0, End: -1 }[event.key];
    if (to !== undefined) {
      go(to);
      event.preventDefault();
    }
  });
  document.addEventListener("keydown", (event) => {
    if (event.altKey && !event.ctrlKey && !event.metaKey && event.key >= "1" && event.key < String(VIEWS.length)) {
      go(Number(event.key) - 1);
      event.preventDefault();
    }
  });
}

function theme() {
  const system = matchMedia("(prefers-color-scheme: dark)");
  const button = document.getElementById("theme");
  const set = (dark, begun = true) => {
    document.documentElement.dataset.theme = dark ? "dark" : "light";
    button.textContent = dark ? "Light" : "Dark";
    button.setAttribute("aria-label", dark ? "Use light colours" : "Use dark colours");
    if (begun) tellViews({ theme: true });
  };
  const kept = localStorage.getItem("limbfit-theme");
  set(kept ? kept === "dark" : system.matches, false);
  system.addEventListener("change", () => localStorage.getItem("limbfit-theme") ?? set(system.matches));
  button.addEventListener("click", () => {
    const dark = document.documentElement.dataset.theme !== "dark";
    localStorage.setItem("limbfit-theme", dark ? "dark" : "light");
    set(dark);
  });
}

async function begin() {
  if (location.search) history.replaceState(null, "", `/${location.hash}`); // the key stays out of sight
  theme();
  tabs();
  await context.load(document.getElementById("view"), "the study", () => poll());
  for (const kind of ["dragover", "drop"]) addEventListener(kind, (event) => event.preventDefault()); // else a file takes the page's place
  addEventListener("hashchange", route);
  route();
}

begin();
