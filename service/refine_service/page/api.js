// Calls of the service: the session's key, problem details as errors, and events as an async iterator.

const STORED = "refine.key";

/** An error that the service, or the way to it, told; `reason` and `status` as docs/rest.md says. */
export class Problem extends Error {
  constructor({ detail, title, reason = "", status = 0, retryable = false, request_id: request = null }) {
    super(detail || title || `HTTP ${status}`);
    Object.assign(this, { reason, status, retryable, request });
  }
}

/** The API key of this tab. */
export const key = {
  get: () => sessionStorage.getItem(STORED),
  set: (value) => sessionStorage.setItem(STORED, value),
  clear: () => sessionStorage.removeItem(STORED),
};

/** A response that is ok; `path` is relative to the page, so that a prefix of a proxy stays. Throws Problem. */
export async function call(path, init = {}) {
  const headers = new Headers(init.headers);
  if (key.get()) headers.set("Authorization", `Bearer ${key.get()}`);
  let response;
  try {
    response = await fetch(new URL(path, document.baseURI), { ...init, headers });
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new Problem({ detail: "The service does not answer. Is it running?", retryable: true });
  }
  if (response.ok) return response;
  const told = await response.json().catch(() => ({ status: response.status, title: response.statusText }));
  if (response.status === 401) document.dispatchEvent(new CustomEvent("key-needed"));
  throw new Problem(told);
}

export const address = (id, rest = "") => `v1/refinements/${encodeURIComponent(id)}${rest}`;
export const getJson = async (path, init) => (await call(path, init)).json();

/** Submit: the files, a CameraSpec and options. The Refinement. */
export function submit({ mesh, silhouette, camera, options }) {
  const form = new FormData();
  form.append("mesh", mesh, mesh.name);
  form.append("silhouette", silhouette, silhouette.name);
  form.append("camera", JSON.stringify(camera));
  form.append("options", JSON.stringify(options));
  return getJson("v1/refinements", { method: "POST", body: form });
}

/** Every event of a refinement up to its end, over lost connections. EventSource cannot send a key. */
export async function* events(id, signal) {
  let last = "0";
  while (!signal.aborted) {
    try {
      const headers = { "Last-Event-ID": last };
      const response = await call(address(id, "/events"), { headers, signal });
      for await (const message of messages(response.body)) {
        last = message.id || last;
        if (!message.data) continue;
        const event = JSON.parse(message.data);
        yield event;
        if (event.type === "completed") return;
      }
    } catch (error) {
      if (error instanceof Problem && !error.retryable) throw error;
    }
    await new Promise((resolve) => setTimeout(resolve, 2000));
  }
}

/** The server-sent events of a body: `{id, data}`. */
async function* messages(body) {
  const reader = body.pipeThrough(new TextDecoderStream()).getReader();
  let text = "";
  for (;;) {
    const { value, done } = await reader.read();
    if (done) return;
    text += value.replaceAll("\r", "");
    const parts = text.split("\n\n");
    text = parts.pop();
    for (const part of parts) {
      const fields = part.split("\n").map((line) => line.match(/^(\w+): ?(.*)$/) ?? []);
      const all = (name) => fields.filter((field) => field[1] === name).map((field) => field[2]);
      yield { id: all("id").at(-1), data: all("data").join("\n") };
    }
  }
}

/** Hand an artifact to the browser's downloads; with a key it cannot be a plain link. */
export async function download(id, artifact) {
  const response = await call(address(id, `/artifacts/${artifact.name}`));
  const link = document.createElement("a");
  link.href = URL.createObjectURL(await response.blob());
  link.download = artifact.name;
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 60_000);
}
