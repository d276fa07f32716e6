// The coarse mesh over its silhouette: which pixels it covers, the 2D IoU, and the picture of both.

import { BufferAttribute, BufferGeometry, DoubleSide, Mesh, MeshBasicMaterial, Scene, WebGLRenderer, WebGLRenderTarget } from "./vendor/three.js";
import { resized, threeCamera } from "./camera.js";

const DRAWN = 640; // pixels of the picture's longest side
const COUNTED = 1024; // pixels of the longest side that the 2D IoU is counted on

/** Renders a mesh as a camera sees it and compares it with a mask. */
export class Overlap {
  constructor(canvas) {
    this.canvas = canvas;
    this.renderer = new WebGLRenderer({ antialias: false, powerPreference: "low-power" });
    this.scene = new Scene();
    this.material = new MeshBasicMaterial({ color: 0xffffff, side: DoubleSide, toneMapped: false });
    this.mesh = null;
    this.mask = null;
  }

  /** Show the triangles of readMesh, or null for none. */
  setMesh(read) {
    this.mesh?.geometry.dispose();
    this.scene.clear();
    this.mesh = null;
    if (!read) return;
    const { positions, faces } = read;
    const geometry = new BufferGeometry();
    geometry.setAttribute("position", new BufferAttribute(positions, 3)).setIndex(new BufferAttribute(faces, 1));
    geometry.computeBoundingSphere();
    this.mesh = new Mesh(geometry, this.material);
    this.mesh.frustumCulled = false;
    this.scene.add(this.mesh);
  }

  /** The 2D IoU of the mesh seen by `camera` (camera.js) with the mask, as the server counts it: pixel centres. */
  iou(camera) {
    const [width, height] = fitted(this.mask, Math.min(COUNTED, Math.max(this.mask.width, this.mask.height)));
    const covered = this.covered(camera, width, height);
    const wanted = scaled(this.mask, width, height);
    let both = 0, either = 0;
    for (let i = 0; i < covered.length; i++) {
      both += covered[i] & wanted[i];
      either += covered[i] | wanted[i];
    }
    return either ? both / either : 0;
  }

  clear() {
    this.canvas.getContext("2d").clearRect(0, 0, this.canvas.width, this.canvas.height);
  }

  /** Draw both into the canvas. `camera` may be null: then the mask alone. */
  draw(camera) {
    const [width, height] = fitted(this.mask, DRAWN);
    Object.assign(this.canvas, { width, height });
    const wanted = scaled(this.mask, width, height);
    const covered = camera && this.mesh ? this.covered(camera, width, height) : new Uint8Array(width * height);
    const style = getComputedStyle(this.canvas);
    const [none, missing, extra, both, outline] = ["none", "missing", "extra", "both", "outline"].map((name) => rgb(style.getPropertyValue(`--${name}`)));
    const picture = new ImageData(width, height);
    for (let i = 0; i < covered.length; i++) {
      const border = covered[i] && isBorder(covered, i, width);
      const colour = border ? outline : covered[i] ? (wanted[i] ? both : extra) : wanted[i] ? missing : none;
      picture.data.set(colour, 4 * i);
    }
    this.canvas.getContext("2d").putImageData(picture, 0, 0);
  }

  /** 1 where the mesh covers the centre of a pixel: Uint8Array (height * width), rows from the top. */
  covered(camera, width, height) {
    const target = new WebGLRenderTarget(width, height, { depthBuffer: false });
    const view = { x: 0, y: 0, width, height };
    this.renderer.setRenderTarget(target);
    this.renderer.setClearColor(0x000000, 1);
    const seen = threeCamera(resized(camera, width, height), this.mesh.geometry.boundingSphere, view, [width, height]);
    this.renderer.render(this.scene, seen);
    const pixels = new Uint8Array(4 * width * height);
    this.renderer.readRenderTargetPixels(target, 0, 0, width, height, pixels);
    this.renderer.setRenderTarget(null);
    target.dispose();
    const covered = new Uint8Array(width * height);
    for (let y = 0; y < height; y++) {
      for (let x = 0; x < width; x++) covered[y * width + x] = pixels[4 * ((height - 1 - y) * width + x)] > 127 ? 1 : 0;
    }
    return covered;
  }
}

/** Width and height of the mask's shape with this longest side. */
function fitted({ width, height }, longest) {
  const scale = longest / Math.max(width, height);
  return [Math.max(1, Math.round(width * scale)), Math.max(1, Math.round(height * scale))];
}

function scaled(mask, width, height) {
  if (mask.width === width && mask.height === height) return mask.object;
  const made = new Uint8Array(width * height);
  for (let y = 0; y < height; y++) {
    const row = Math.floor(((y + 0.5) * mask.height) / height) * mask.width;
    for (let x = 0; x < width; x++) made[y * width + x] = mask.object[row + Math.floor(((x + 0.5) * mask.width) / width)];
  }
  return made;
}

function isBorder(covered, i, width) {
  return !(covered[i - 1] && covered[i + 1] && covered[i - width] && covered[i + width] && covered[i - width - 1] && covered[i + width + 1]);
}

/** Four bytes of a colour that CSS says as #rrggbb. */
function rgb(colour) {
  const number = parseInt(colour.trim().slice(1), 16);
  return [number >> 16, (number >> 8) & 255, number & 255, 255];
}
