// "New": choose files or a sample, put the mesh over its silhouette with the camera, submit.

import { submit } from "./api.js";
import { otherReadings, readCamera } from "./camera.js";
import { element, fixed, oncePerFrame, shown } from "./dom.js";
import { readMesh, readSilhouette, Unshown } from "./files.js";
import { Overlap } from "./overlap.js";

const SAMPLES = ["chair", "airplane", "car"];
const ALREADY_GOOD = 0.9, GOOD = 0.5, FAR = 0.1; // 2D IoU; from the first the default returns the mesh as it came
const PICKED = { mesh: readMesh, silhouette: readSilhouette, camera: async (file) => JSON.parse(await file.text()) };

/** The view; it keeps its state while other views are shown. */
export class Try {
  constructor(root) {
    this.root = root;
    this.form = root.querySelector("#request");
    this.files = {}; // what is submitted
    this.read = {}; // what is shown
    this.update = oncePerFrame(() => this.showOverlap());
    try {
      this.overlap = new Overlap(root.querySelector("#overlap"));
    } catch {
      this.overlap = null; // submitting works all the same
      root.querySelector("#verdict").textContent = "This browser shows no WebGL, so nothing is drawn here.";
    }
    this.listen();
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", this.update);
    this.showForm();
  }

  listen() {
    for (const drop of this.root.querySelectorAll(".drop")) {
      const input = drop.querySelector("input");
      input.addEventListener("change", () => input.files[0] && this.pick(drop.dataset.kind, input.files[0]));
      drop.addEventListener("dragover", () => drop.classList.add("over"));
      for (const kind of ["dragleave", "drop"]) drop.addEventListener(kind, () => drop.classList.remove("over"));
    }
    this.root.addEventListener("drop", (event) => {
      const zone = event.target.closest(".drop");
      for (const file of event.dataTransfer.files) this.pick(kindOf(file) ?? zone?.dataset.kind, file);
    });
    const samples = this.root.querySelector(".samples");
    for (const name of SAMPLES) {
      const picture = element("img", { src: `page/samples/${name}/silhouette.png`, alt: "", width: 28, height: 28 });
      const button = element("button", { type: "button", className: "quiet" }, picture, name[0].toUpperCase() + name.slice(1));
      button.addEventListener("click", () => this.pickSample(name));
      samples.append(button);
    }
    for (const range of this.form.querySelectorAll("[data-number]")) {
      const number = this.form.querySelector(`#${range.dataset.number}`);
      const log = "log" in range.dataset;
      range.addEventListener("input", () => {
        number.value = log ? Number((10 ** range.valueAsNumber).toPrecision(3)) : range.value;
        this.update();
      });
      number.addEventListener("input", () => {
        range.value = log ? Math.log10(number.valueAsNumber) : number.value;
      });
    }
    this.form.addEventListener("input", () => (this.showForm(), this.update()));
    this.form.elements.matrix.addEventListener("input", () => this.readPasted());
    this.form.addEventListener("submit", (event) => (event.preventDefault(), this.send()));
    this.root.querySelector("#better button").addEventListener("click", () => this.setCamera(this.better));
    this.listenToDrags(this.root.querySelector("#overlap"));
  }

  /** Dragging in the picture turns a camera that is given as angles. */
  listenToDrags(canvas) {
    canvas.addEventListener("pointerdown", (event) => canvas.setPointerCapture(event.pointerId));
    canvas.addEventListener("pointermove", (event) => {
      const spec = this.spec();
      if (!event.buttons || spec.type !== "look_at") return;
      const azimuth = ((spec.azimuth_degrees - event.movementX / 2 + 540) % 360) - 180;
      const elevation = Math.max(-90, Math.min(90, spec.elevation_degrees + event.movementY / 2));
      this.setCamera({ ...spec, azimuth_degrees: azimuth, elevation_degrees: elevation });
    });
  }

  async pickSample(name) {
    try {
      for (const [kind, file] of [["mesh", "coarse.obj"], ["silhouette", "silhouette.png"], ["camera", "camera.json"]]) {
        const response = await fetch(`page/samples/${name}/${file}`);
        if (!response.ok) throw new Error(`the sample ${name} is not there (HTTP ${response.status})`);
        await this.pick(kind, new File([await response.blob()], file), `${name}/${file}`);
      }
    } catch (error) {
      this.tell("files", error);
    }
  }

  async pick(kind, file, label = file.name) {
    this.tell("files");
    try {
      if (!kind) throw new Error("expected a mesh, an image or a camera as JSON");
      const read = await PICKED[kind](file).catch((error) => this.unshown(file, error));
      if (kind === "camera") {
        readCamera(read, 2, 2); // throws what is wrong with it
        this.setCamera(read);
      } else {
        this.files[kind] = file;
        this.read[kind] = read;
        if (this.overlap && kind === "mesh") this.overlap.setMesh(read);
        if (this.overlap && kind === "silhouette") this.overlap.mask = read;
      }
      this.root.querySelector(`.drop[data-kind=${kind}] .file-name`).textContent = label;
    } catch (error) {
      this.tell("files", new Error(`${label}: ${error.message}`));
    }
    this.update();
  }

  /** What to show of a file that only the server can read: nothing, and a word. */
  unshown(file, error) {
    if (!(error instanceof Unshown)) throw error;
    this.tell("files", new Error(`${file.name} is ${error.message}: the server reads it, but this page cannot show it`));
    return null;
  }

  /** The CameraSpec that the form says; NaN where it says no number. */
  spec() {
    const { elements } = this.form;
    if (elements.type.value === "look_at") {
      const numbers = ["azimuth_degrees", "elevation_degrees", "distance", "fov_y_degrees"];
      return { type: "look_at", ...Object.fromEntries(numbers.map((name) => [name, elements[name].valueAsNumber])) };
    }
    const numbers = elements.matrix.value.match(/[-+.\d][-+.\deE]*/g)?.map(Number) ?? [];
    const rows = [0, 4, 8, 12].map((start) => numbers.slice(start, start + 4));
    if (numbers.length > 16) rows.push(numbers.slice(16));
    const spec = { type: "matrix", convention: elements.convention.value, [elements.direction.value]: rows };
    if (elements.lens.value === "fov") return { ...spec, fov_y_degrees: elements.matrix_fov.valueAsNumber };
    const [fx, fy, cx, cy] = elements.intrinsics.value.trim().split(/[\s,]+/).map(Number);
    const projection = elements.lens.value === "orthographic" ? { projection: "orthographic" } : {};
    return { ...spec, ...projection, intrinsics: { fx, fy, cx, cy } };
  }

  /** Show a CameraSpec in the form. */
  setCamera(spec) {
    const { elements } = this.form;
    elements.type.value = spec.type ?? "look_at";
    if (elements.type.value === "look_at") {
      for (const name of ["azimuth_degrees", "elevation_degrees", "distance", "fov_y_degrees"]) {
        elements[name].value = Number((spec[name] ?? 60).toFixed(3));
        elements[name].dispatchEvent(new Event("input", { bubbles: true }));
      }
    } else {
      elements.direction.value = spec.world_to_camera ? "world_to_camera" : "camera_to_world";
      const rows = (spec.world_to_camera ?? spec.camera_to_world).flat();
      elements.matrix.value = [0, 4, 8, 12].map((start) => rows.slice(start, start + 4).join(" ")).join("\n");
      elements.convention.value = spec.convention;
      elements.lens.value = spec.projection === "orthographic" ? "orthographic" : spec.intrinsics ? "intrinsics" : "fov";
      if (spec.intrinsics) elements.intrinsics.value = ["fx", "fy", "cx", "cy"].map((name) => spec.intrinsics[name]).join(" ");
      else elements.matrix_fov.value = spec.fov_y_degrees;
    }
    this.showForm();
    this.update();
  }

  /** A whole camera that was pasted as JSON fills the form. */
  readPasted() {
    let spec;
    try {
      spec = JSON.parse(this.form.elements.matrix.value);
      if (!spec.type) return;
      readCamera(spec, 2, 2);
    } catch {
      return; // numbers, or not yet a camera
    }
    this.setCamera(spec);
  }

  showForm() {
    const { elements } = this.form;
    for (const part of this.form.querySelectorAll("[data-for]")) shown(part, part.dataset.for === elements.type.value);
    for (const part of this.form.querySelectorAll("[data-lens]")) shown(part, (part.dataset.lens === "fov") === (elements.lens.value === "fov"));
  }

  showOverlap() {
    const { mesh, silhouette } = this.read;
    const spec = this.spec();
    this.form.querySelector("#spec").textContent = JSON.stringify(spec, null, 1);
    let camera = null;
    try {
      camera = readCamera(spec, silhouette?.width ?? 2, silhouette?.height ?? 2);
      this.tell("camera");
    } catch (error) {
      this.tell("camera", error);
    }
    this.form.querySelector("button.primary").disabled = !(this.files.mesh && this.files.silhouette && camera) || this.sending;
    if (!this.overlap || !this.root.isConnected) return;
    if (silhouette) this.overlap.draw(mesh && camera);
    else this.overlap.clear();
    const iou = mesh && silhouette && camera ? this.overlap.iou(camera) : null;
    this.root.querySelector("#iou").textContent = iou === null ? "–" : fixed(iou, 3);
    const words = iou === null ? "Choose a mesh and a silhouette, and set the camera." : verdict(iou);
    const told = this.root.querySelector("#verdict");
    if (told.textContent !== words) told.textContent = words;
    this.overlap.canvas.setAttribute("aria-label", iou === null ? "The silhouette" : `The mesh over its silhouette, 2D IoU ${fixed(iou, 2)}`);
    this.showBetter(spec, iou);
  }

  /** Where another reading of the same matrix fits much better, offer it. */
  showBetter(spec, iou) {
    const line = this.root.querySelector("#better");
    shown(line, false);
    if (spec.type !== "matrix" || iou === null || iou >= GOOD) return;
    const { width, height } = this.read.silhouette;
    const readings = otherReadings(spec).map((other) => ({ other, iou: this.overlap.iou(readCamera(other, width, height)) }));
    const best = readings.reduce((a, b) => (b.iou > a.iou ? b : a));
    if (best.iou < Math.max(GOOD, 1.5 * iou)) return;
    this.better = best.other;
    const direction = best.other.world_to_camera ? "world to camera" : "camera to world";
    line.querySelector("span").textContent = `Read as ${best.other.convention}, ${direction}, the 2D IoU is ${fixed(best.iou)}.`;
    shown(line);
  }

  async send() {
    const { preset, iterations, seed } = this.form.elements;
    const options = { preset: preset.value, seed: seed.valueAsNumber || 0 };
    if (iterations.value) options.iterations = iterations.valueAsNumber;
    this.sending = true;
    this.update();
    this.tell("submit");
    try {
      const refinement = await submit({ ...this.files, camera: this.spec(), options });
      location.hash = `#/refinements/${refinement.id}`;
    } catch (error) {
      this.tell("submit", error);
    } finally {
      this.sending = false;
      this.update();
    }
  }

  tell(where, error = null) {
    this.root.querySelector(`[data-error=${where}]`).textContent = error?.message ?? "";
  }
}

function kindOf({ name }) {
  if (/\.json$/i.test(name)) return "camera";
  if (/\.(png|jpe?g|webp|tiff?|bmp)$/i.test(name)) return "silhouette";
  return /\.(glb|gltf|obj|ply|stl|off|zip|binvox|npz)$/i.test(name) ? "mesh" : null;
}

function verdict(iou) {
  if (iou >= ALREADY_GOOD) return "The mesh agrees with its silhouette already; the default returns it as it came.";
  if (iou >= GOOD) return "A good start.";
  if (iou >= FAR) return "Little overlap. Is the camera right?";
  return "The mesh is not where the silhouette is. The camera is wrong, or in another convention.";
}
