// Requests to the study's server. Errors carry the line that the command line would print.
export class ApiError extends Error {
  constructor(text, status) {
    super(text);
    this.status = status;
  }
}

async function ask(path, options = {}) {
  let answer;
  try {
    answer = await fetch(`/api/${path}`, { cache: "no-store", credentials: "same-origin", ...options });
  } catch {
    throw new ApiError("the server does not answer", 0);
  }
  if (answer.ok) return answer;
  let text = `the server answered ${answer.status}`;
  try {
    text = (await answer.json()).error ?? text;
  } catch {
    // an answer without a reason
  }
  throw new ApiError(text, answer.status);
}

export const api = {
  get: async (path) => (await ask(path)).json(),
  bytes: async (path) => (await ask(path)).arrayBuffer(),
  post: async (path, body = {}) =>
    (await ask(path, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) })).json(),
  send: async (path, body) =>
    (await ask(path, { method: "POST", headers: { "Content-Type": "application/octet-stream" }, body })).json(),
  url: (path) => `/api/${path}`,
};
