// The view Traces.
import { el } from "/static/dom.js";

export function mount(element, context) {
  element.append(el("p", { class: "padded" }, context.study?.name ?? ""));
}
