// The studio's HTTP API: JSON in and out, and errors as the sentences that it gives.

export const API = "/api/v1";

// What the studio refused, or could not be asked; `message` is for people.
export class Refused extends Error {
  constructor(status, message) {
    super(message);
    this.status = status; // of HTTP; 0 without an answer
  }
}

// get("/episodes", {task: "wiping"}) and the like give what the studio answers; each may throw Refused.
export const api = {
  get: (path, query, options = {}) => ask("GET", path, { query, ...options }),
  post: (path, body, query) => ask("POST", path, { body, query }),
  put: (path, body, query) => ask("PUT", path, { body, query }),
  del: (path, query) => ask("DELETE", path, { query }),
  bytes: (path, query, options = {}) => ask("GET", path, { query, as: "arrayBuffer", ...options }),
  url: (path, query) => API + path + queryOf(query),
};

async function ask(method, path, { body, query, signal, as = "json" }) {
  const headers = body === undefined ? {} : { "Content-Type": "application/json" };
  let answer;
  try {
    answer = await fetch(api.url(path, query), {
      method, headers, signal, body: body === undefined ? undefined : JSON.stringify(body),
    });
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new Refused(0, "The studio does not answer. Is it still running?");
  }
  if (!answer.ok) throw new Refused(answer.status, await sentenceOf(answer));
  return answer.status === 204 ? null : answer[as]();
}

// {a: 1, b: [2, 3], c: null} as ?a=1&b=2&b=3
function queryOf(query = {}) {
  const pairs = new URLSearchParams();
  for (const [name, value] of Object.entries(query)) {
    for (const item of Array.isArray(value) ? value : [value]) {
      if (item !== null && item !== undefined && item !== "") pairs.append(name, item);
    }
  }
  const text = pairs.toString();
  return text && `?${text}`;
}

async function sentenceOf(answer) {
  const text = await answer.text();
  try {
    const { detail } = JSON.parse(text);
    if (typeof detail === "string") return detail;
    return detail.map(({ loc, msg }) => `${loc.slice(1).join(" ")}: ${msg}`).join("; ");
  } catch {
    return text || `The studio answered ${answer.status}.`;
  }
}
