// Before and after in one 3D view: one camera, a line between them, and the input silhouette over both.

import {
  BufferAttribute, BufferGeometry, Color, DirectionalLight, DoubleSide, EdgesGeometry, HemisphereLight,
  LineBasicMaterial, LineSegments, Mesh, MeshBasicMaterial, MeshLambertMaterial, OrbitControls, PerspectiveCamera, Scene, SRGBColorSpace, Vector3, WebGLRenderer,
} from "./vendor/three.js";
import { standsAt, threeCamera } from "./camera.js";
import { colourOf } from "./colours.js";
import { oncePerFrame } from "./dom.js";

const FOV = 35; // degrees, of the free camera
const MOST_EDGES = 300_000; // corners of triangles: finding edges among more takes seconds
const STEP = 10; // degrees that an arrow key turns
const DIRECTIONS = { front: [0, 0, 1], back: [0, 0, -1], right: [1, 0, 0], left: [-1, 0, 0], top: [0, 1, 1e-3] };

/**
 * `canvas` shows the meshes and `outline`, above it, the silhouette. `before` and `after` are {positions, faces};
 * `input` is {camera (camera.js), object, width, height} or null. Call `dispose` at the end.
 */
export class Viewer {
  constructor({ canvas, outline, before, after, input }) {
    Object.assign(this, { canvas, outline, input });
    this.renderer = new WebGLRenderer({ canvas, antialias: true, alpha: true });
    this.renderer.setScissorTest(true);
    this.split = 0.5;
    this.showSilhouette = true;
    this.seenByInput = false;
    this.box = input && boxOf(input);
    this.contour = input && contourOf(input);
    this.sides = [before, after].map(sideOf);
    this.sphere = this.sides[0].mesh.geometry.boundingSphere;
    this.free = new PerspectiveCamera(FOV, 1, this.sphere.radius / 100, this.sphere.radius * 100);
    this.controls = new OrbitControls(this.free, canvas);
    this.controls.target.copy(this.sphere.center);
    this.controls.enablePan = false;
    this.controls.minDistance = this.sphere.radius * 0.8;
    this.controls.maxDistance = this.sphere.radius * 20;
    this.controls.addEventListener("start", () => this.leaveInput());
    this.controls.addEventListener("change", () => this.draw());
    this.draw = oncePerFrame(() => this.render());
    this.sizes = new ResizeObserver(() => this.draw());
    this.sizes.observe(canvas);
    canvas.addEventListener("keydown", (event) => this.onKey(event));
    this.see(input ? "input" : "front");
  }

  /** "input", "front", "right", "back", "left" or "top". */
  see(view) {
    const { center, radius } = this.sphere;
    this.seenByInput = view === "input" && Boolean(this.input);
    const direction = new Vector3(...(DIRECTIONS[view] ?? [0.6, 0.4, 1]));
    if (this.seenByInput) direction.fromArray(standsAt(this.input.camera)).sub(center);
    const distance = (1.1 * radius) / Math.sin((FOV / 2) * (Math.PI / 180));
    this.free.position.copy(direction.normalize().multiplyScalar(distance).add(center));
    this.controls.update();
    this.draw();
  }

  leaveInput() {
    this.seenByInput = false;
    this.draw();
  }

  /** Turn by degrees around the world's up axis, and up by degrees. */
  turn(degrees, up = 0) {
    this.leaveInput();
    const offset = this.free.position.clone().sub(this.sphere.center);
    const distance = offset.length();
    const azimuth = Math.atan2(offset.x, offset.z) + (degrees * Math.PI) / 180;
    const most = Math.PI / 2 - 1e-3;
    const elevation = Math.min(most, Math.max(-most, Math.asin(offset.y / distance) + (up * Math.PI) / 180));
    offset.set(Math.cos(elevation) * Math.sin(azimuth), Math.sin(elevation), Math.cos(elevation) * Math.cos(azimuth));
    this.free.position.copy(offset.multiplyScalar(distance).add(this.sphere.center));
    this.controls.update();
    this.draw();
  }

  /** Turn on its own, or stop. */
  set turning(is) {
    cancelAnimationFrame(this.frame);
    let last = null;
    const step = (now) => {
      if (last !== null) this.turn(((now - last) / 1000) * 30);
      last = now;
      this.frame = requestAnimationFrame(step);
    };
    if (is) this.frame = requestAnimationFrame(step);
  }

  onKey(event) {
    const turns = { ArrowLeft: [-STEP, 0], ArrowRight: [STEP, 0], ArrowUp: [0, STEP], ArrowDown: [0, -STEP] };
    if (turns[event.key]) this.turn(...turns[event.key]);
    else if ("+-=".includes(event.key)) {
      this.leaveInput();
      this.free.position.sub(this.sphere.center).multiplyScalar(event.key === "-" ? 1.1 : 1 / 1.1).add(this.sphere.center);
      this.controls.update();
    } else return;
    event.preventDefault();
  }

  /** Colour the mesh after by values in [0, 1] per vertex; null: plain. */
  colour(values) {
    const { mesh, plain, coloured } = this.sides[1];
    mesh.material = values ? coloured : plain;
    if (values) this.edges ??= edgesOf(mesh);
    if (this.edges) this.edges.visible = Boolean(values);
    if (values) {
      const colours = new Float32Array(3 * values.length);
      const colour = new Color();
      values.forEach((value, i) => colour.setRGB(...colourOf(value), SRGBColorSpace).toArray(colours, 3 * i));
      mesh.geometry.setAttribute("color", new BufferAttribute(colours, 3));
    }
    this.draw();
  }

  render() {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    if (!width || !height) return;
    this.renderer.setPixelRatio(Math.min(devicePixelRatio, 2));
    this.renderer.setSize(width, height, false);
    const camera = this.seenByInput ? threeCamera(this.input.camera, this.sphere, this.imageArea(width, height), [width, height]) : this.free;
    this.free.aspect = width / height;
    this.free.fov = width < height ? 2 * Math.atan(Math.tan((FOV / 2) * (Math.PI / 180)) * (height / width)) * (180 / Math.PI) : FOV;
    this.free.updateProjectionMatrix();
    const at = Math.round(this.split * width);
    [[0, at], [at, width - at]].forEach(([x, wide], side) => {
      this.renderer.setScissor(x, 0, wide, height);
      this.sides[side].headlight.position.copy(new Vector3(-0.4, 0.6, 1).transformDirection(camera.matrixWorld));
      this.renderer.render(this.sides[side].scene, camera);
    });
    this.drawOutline(width, height);
  }

  /** Where the input image lies in a canvas of this size: its object fills three quarters of it. */
  imageArea(width, height) {
    const { left, top, right, bottom } = this.box;
    const scale = 0.75 * Math.min(width / (right - left), height / (bottom - top));
    const [x, y] = [width / 2 - (scale * (left + right)) / 2, height / 2 - (scale * (top + bottom)) / 2];
    return { x, y, width: scale * this.input.width, height: scale * this.input.height };
  }

  drawOutline(width, height) {
    Object.assign(this.outline, { width, height });
    if (!this.seenByInput || !this.showSilhouette) return;
    const area = this.imageArea(width, height);
    const scale = area.width / this.input.width;
    const context = this.outline.getContext("2d");
    context.strokeStyle = getComputedStyle(this.outline).color;
    context.setTransform(scale, 0, 0, scale, area.x, area.y);
    context.lineWidth = 2 / scale;
    context.stroke(this.contour);
  }

  dispose() {
    this.turning = false;
    this.sizes.disconnect();
    this.controls.dispose();
    for (const { mesh } of this.sides) mesh.geometry.dispose();
    this.edges?.geometry.dispose();
    this.renderer.dispose();
    this.renderer.forceContextLoss();
  }
}

/** The box around the object of a silhouette, pixels. */
function boxOf({ object, width, height }) {
  const box = { left: width, top: height, right: 0, bottom: 0 };
  object.forEach((is, i) => {
    if (!is) return;
    const [x, y] = [i % width, Math.floor(i / width)];
    box.left = Math.min(box.left, x);
    box.right = Math.max(box.right, x + 1);
    box.top = Math.min(box.top, y);
    box.bottom = Math.max(box.bottom, y + 1);
  });
  return box;
}

/** The border between a silhouette and its background, along the sides of its pixels. */
function contourOf({ object, width, height }) {
  const path = new Path2D();
  const side = (fromX, fromY, toX, toY) => (path.moveTo(fromX, fromY), path.lineTo(toX, toY));
  const is = (x, y) => x >= 0 && y >= 0 && x < width && y < height && object[y * width + x] > 0;
  for (let y = 0; y < height; y++) {
    for (let x = 0; x < width; x++) {
      if (!is(x, y)) continue;
      if (!is(x - 1, y)) side(x, y, x, y + 1);
      if (!is(x + 1, y)) side(x + 1, y, x + 1, y + 1);
      if (!is(x, y - 1)) side(x, y, x + 1, y);
      if (!is(x, y + 1)) side(x, y + 1, x + 1, y + 1);
    }
  }
  return path;
}

/** A scene with one mesh, its lights and its materials. */
function sideOf({ positions, faces }) {
  const geometry = new BufferGeometry();
  geometry.setAttribute("position", new BufferAttribute(positions, 3)).setIndex(new BufferAttribute(faces, 1));
  geometry.computeBoundingSphere();
  const plain = new MeshLambertMaterial({ color: 0xa8b8d1, side: DoubleSide, flatShading: true });
  const coloured = new MeshBasicMaterial({ vertexColors: true, side: DoubleSide }); // unlit: the colours of the legend
  const mesh = new Mesh(geometry, plain);
  mesh.frustumCulled = false;
  const headlight = new DirectionalLight(0xffffff, 2.6);
  const scene = new Scene().add(mesh, new HemisphereLight(0xffffff, 0x6a6a76, 0.9), headlight);
  return { scene, mesh, headlight, plain, coloured };
}

/** The sharp edges of a mesh as lines on it, where colours leave no shade to see the shape by; null for a large one. */
function edgesOf(mesh) {
  if (mesh.geometry.index.count > MOST_EDGES) return null;
  const faint = new LineBasicMaterial({ color: 0x000000, transparent: true, opacity: 0.22 });
  const edges = new LineSegments(new EdgesGeometry(mesh.geometry, 20), faint);
  mesh.add(edges);
  return edges;
}
