// One refinement: its progress until it ends, then before and after, the numbers in words, and the files.

import { address, call, download, events, getJson } from "./api.js";
import { drawChart } from "./chart.js";
import { drawScale } from "./colours.js";
import { bytes, element, fixed, seconds, short, shown } from "./dom.js";
import { Matrix4 } from "./vendor/three.js";
import { readNpz } from "./npz.js";
import { Viewer } from "./viewer.js";
import { confidenceWords, reportWords, stateWords } from "./words.js";

const ENDED = ["succeeded", "failed", "cancelled", "expired"];

/** The view of the refinement `id` in `root`. Call `close` when it is left. */
export class One {
  constructor(root, id) {
    Object.assign(this, { root, id });
    this.left = new AbortController();
    this.find = (selector) => root.querySelector(selector);
    this.find(".id").textContent = id.slice(0, 8);
    this.find(".cancel").addEventListener("click", () => this.cancel());
    this.follow();
  }

  close() {
    this.left.abort();
    this.viewer?.dispose();
  }

  async follow() {
    try {
      let refinement = await getJson(address(this.id), { signal: this.left.signal });
      this.showState(refinement);
      if (!ENDED.includes(refinement.state)) {
        shown(this.find(".watch"));
        const curves = {};
        for await (const event of events(this.id, this.left.signal)) {
          if (event.refinement) refinement = event.refinement;
          else this.showState(event.state === "queued" ? refinement : { state: event.state });
          if (event.progress) this.showProgress(event.progress, curves);
        }
        shown(this.find(".watch"), false);
        this.showState(refinement);
      }
      if (refinement.state === "succeeded") await this.showResult(refinement);
    } catch (error) {
      if (error.name !== "AbortError") this.tell(error);
    }
  }

  showState(refinement) {
    this.find(".state").textContent = stateWords(refinement);
    this.find(".cancel").disabled = refinement.state === "cancelling";
    if (refinement.error) this.tell({ message: refinement.error.detail, reason: refinement.error.reason });
  }

  showProgress({ iteration, total, percent, eta_s: eta, losses, silhouette_iou: iou }, curves) {
    this.find("progress").value = percent;
    const left = eta ? `, about ${seconds(eta)} left` : "";
    const agreement = iou ? `, 2D IoU ${fixed(iou, 3)}` : "";
    this.find(".progress-words").textContent = `Iteration ${iteration} of ${total}${left}${agreement}.`;
    if (!Object.keys(losses).length) return;
    for (const [name, value] of Object.entries(losses)) (curves[name] ??= []).push(value);
    shown(this.find(".watch .losses"));
    drawChart(this.find(".watch .chart"), curves);
  }

  async cancel() {
    this.find(".cancel").disabled = true;
    try {
      await call(address(this.id, "/cancel"), { method: "POST" });
    } catch (error) {
      this.find(".cancel").disabled = false;
      this.tell(error);
    }
  }

  async showResult(refinement) {
    shown(this.find(".result"));
    for (const artifact of refinement.artifacts) {
      const button = element("button", { type: "button", className: "link" }, artifact.name);
      button.addEventListener("click", () => download(this.id, artifact).catch((error) => this.tell(error)));
      this.find(".downloads").append(element("li", {}, button, ` ${FILES[artifact.name] ?? ""} (${bytes(artifact.size_bytes)})`));
    }
    const get = (name) => call(address(this.id, `/artifacts/${name}`), { signal: this.left.signal });
    const report = await (await get("report.json")).json();
    this.find(".words ul").replaceChildren(...reportWords(report, refinement.options).map((words) => element("li", {}, words)));
    this.find(".warnings").replaceChildren(...report.warnings.map((words) => element("li", {}, `Warning: ${words}.`)));
    drawChart(this.find(".result > .losses .chart"), report.loss_curve ?? {});
    shown(this.find(".result > .losses"), this.find(".result > .losses svg") !== null);
    const arrays = await readNpz(await (await get("confidence.npz")).arrayBuffer());
    if (!this.left.signal.aborted) this.showMeshes(arrays, report);
  }

  showMeshes(arrays, report) {
    const after = { positions: arrays.vertices.data, faces: Uint32Array.from(arrays.faces.data) };
    const coarse = arrays.coarse_vertices;
    const before = coarse ? { positions: coarse.data, faces: Uint32Array.from(arrays.coarse_faces.data) } : after;
    try {
      this.viewer = new Viewer({ canvas: this.find(".mesh"), outline: this.find(".outline"), before, after, input: inputOf(arrays) });
    } catch {
      this.tell({ message: "This browser shows no WebGL, so there is no 3D view; preview.png among the downloads shows the result." });
      return;
    }
    const moved = distances(before.positions, after.positions);
    const most = moved.reduce((a, b) => Math.max(a, b), 0);
    const size = longestSide(before.positions);
    this.colours = {
      plain: null,
      confidence: { values: arrays.vertex.data, low: "0", high: "1", words: confidenceWords(report) },
      displacement: {
        values: moved.map((x) => x / (most || 1)),
        low: "0",
        high: short(most),
        words: `How far each place was moved, world units. The largest is ${short((100 * most) / size)} % of the object's size.`,
      },
    };
    this.listen();
  }

  listen() {
    const { viewer, find } = this;
    const split = find(".split");
    const place = () => {
      viewer.split = split.valueAsNumber / 100;
      find(".stage").style.setProperty("--split", `${split.value}%`);
      viewer.draw();
    };
    split.addEventListener("input", place);
    place();
    for (const button of this.root.querySelectorAll("[data-view]")) button.addEventListener("click", () => viewer.see(button.dataset.view));
    find(".turn").addEventListener("change", (event) => (viewer.turning = event.target.checked));
    find(".show-silhouette").addEventListener("change", (event) => {
      viewer.showSilhouette = event.target.checked;
      if (event.target.checked) viewer.see("input");
      viewer.draw();
    });
    drawScale(find(".legend canvas"));
    for (const radio of this.root.querySelectorAll("[name=colours]")) radio.addEventListener("change", () => this.showColours(radio.value));
    this.showColours(find("[name=colours]:checked").value); // whoever was quicker than the files
  }

  showColours(name) {
    const colours = this.colours[name];
    this.viewer.colour(colours && colours.values);
    shown(this.find(".legend"), Boolean(colours));
    if (!colours) return;
    this.find(".legend .low").textContent = colours.low;
    this.find(".legend .high").textContent = colours.high;
    this.find(".legend p").textContent = colours.words;
  }

  tell({ message, reason }) {
    this.find(".error").textContent = reason ? `${message} (${reason})` : message;
  }
}

const FILES = {
  "refined.glb": "the refined mesh, for any glTF viewer",
  "confidence.glb": "the refined mesh in the colours of its symmetry confidence",
  "confidence.png": "the confidence as the input camera sees it",
  "confidence.npz": "the confidence as numbers, per vertex and from all views",
  "preview.png": "before and after as a picture",
  "report.json": "everything that was measured",
};

/** The input silhouette and who saw it, of confidence.npz; null if an older version wrote it. */
function inputOf(arrays) {
  if (!arrays.silhouette) return null;
  const [height, width] = arrays.silhouette.shape;
  const [fx, fy, cx, cy] = arrays.silhouette_intrinsics.data;
  const matrix = new Matrix4().set(...arrays.silhouette_camera.data);
  const camera = { matrix, fx, fy, cx, cy, width, height, orthographic: arrays.silhouette_orthographic.data[0] > 0 };
  return { camera, width, height, object: arrays.silhouette.data };
}

function distances(from, to) {
  return Float32Array.from({ length: from.length / 3 }, (_, i) => Math.hypot(to[3 * i] - from[3 * i], to[3 * i + 1] - from[3 * i + 1], to[3 * i + 2] - from[3 * i + 2]));
}

function longestSide(positions) {
  let longest = 0;
  for (const axis of [0, 1, 2]) {
    let [low, high] = [Infinity, -Infinity];
    for (let i = axis; i < positions.length; i += 3) [low, high] = [Math.min(low, positions[i]), Math.max(high, positions[i])];
    longest = Math.max(longest, high - low);
  }
  return longest;
}
