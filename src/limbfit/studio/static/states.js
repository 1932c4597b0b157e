// What stands in the place of content: that it is being read, that there is none yet, or why it cannot be read.
import { ApiError } from "/static/api.js";
import { el, replace } from "/static/dom.js";

const states = new WeakMap();

/**
 * Read what `place`, a positioned element, shows. `what` names it: content of the same name stays while it is read
 * again, and where that fails `warn(text)` is called. Otherwise the place says that it is being read, and where `read`
 * throws, why, with a button to try again. `read` returns nothing, or what is missing: { text, actions }.
 */
export async function load(place, what, read, warn) {
  const state = stateOf(place), turn = ++state.turn;
  if (state.what !== what) {
    state.what = what;
    show(place, "loading", el("progress", { "aria-label": `Reading ${what}` }), el("p", {}, `Reading ${what} …`));
  }
  let missing;
  try {
    missing = await read();
  } catch (error) {
    if (!(error instanceof ApiError)) console.error(error);
    if (state.what !== what) return; // something else has taken the place
    if (turn !== state.turn || ["ready", "empty"].includes(place.dataset.state)) return warn(error.message);
    const again = () => {
      state.what = null;
      load(place, what, read, warn);
    };
    show(place, "failed", el("p", {}, `Cannot read ${what}: ${error.message}`), el("button", { type: "button", onclick: again }, "Try again"));
    return;
  }
  if (turn !== state.turn) return;
  if (!missing) show(place, "ready");
  else if (place.dataset.state !== "empty" || missing.text !== state.missing) {
    state.missing = missing.text; // what says the same is left alone: who is clicking there would lose the click
    show(place, "empty", el("p", {}, missing.text), el("div", { class: "row" }, missing.actions ?? []));
  }
}

function stateOf(place) {
  if (!states.has(place)) states.set(place, { turn: 0, panel: el("div", {}) });
  return states.get(place);
}

function show(place, kind, ...content) {
  const { panel } = stateOf(place);
  place.dataset.state = kind;
  panel.className = `state ${kind}`;
  panel.setAttribute("role", kind === "failed" ? "alert" : "status");
  panel.hidden = kind === "ready";
  replace(panel, ...content);
  if (panel.parentNode !== place) place.append(panel);
}
