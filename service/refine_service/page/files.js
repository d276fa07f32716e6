// The files of a request, read in the browser: meshes as triangles, silhouettes as masks.

import { GLTFLoader, OBJLoader, PLYLoader, STLLoader, Vector3 } from "./vendor/three.js";

/** The triangles of a mesh file: positions Float32Array (V * 3), faces Uint32Array (F * 3). Throws an Error in words. */
export async function readMesh(file) {
  let read;
  try {
    read = await parse(file);
  } catch (error) {
    throw new Error(`this mesh cannot be read: ${error.message}`);
  }
  if (!read.faces.length) throw new Error("expected triangles, found none");
  return read;
}

async function parse(file) {
  const bytes = await file.arrayBuffer();
  const head = new TextDecoder("latin1").decode(bytes.slice(0, 1024)).trimStart();
  const suffix = file.name.split(".").pop().toLowerCase();
  const text = () => new TextDecoder().decode(bytes);
  if (head.startsWith("glTF")) return ofScene((await new GLTFLoader().parseAsync(bytes, "")).scene);
  if (head.startsWith("{")) return ofScene((await new GLTFLoader().parseAsync(text(), "")).scene);
  if (/^ply\s/.test(head)) return ofGeometries([new PLYLoader().parse(bytes)]);
  if (suffix === "obj") return ofScene(new OBJLoader().parse(text()));
  if (suffix === "stl") return ofGeometries([new STLLoader().parse(bytes)]);
  if (suffix === "off" || /^\w*OFF/.test(head)) return readOff(text());
  throw new Error("expected a GLB, glTF, OBJ, PLY, STL or OFF file");
}

function ofScene(scene) {
  scene.updateMatrixWorld(true);
  const geometries = [];
  scene.traverse((node) => {
    if (!node.isMesh) return;
    const point = new Vector3();
    const geometry = node.geometry.clone();
    const position = geometry.getAttribute("position").clone();
    for (let i = 0; i < position.count; i++) {
      node.getVertexPosition(i, point).applyMatrix4(node.matrixWorld);
      position.setXYZ(i, point.x, point.y, point.z);
    }
    geometries.push(geometry.setAttribute("position", position));
  });
  return ofGeometries(geometries);
}

function ofGeometries(geometries) {
  const positions = [], faces = [];
  for (const geometry of geometries) {
    const position = geometry.getAttribute("position");
    const start = positions.length / 3;
    for (let i = 0; i < position.count; i++) positions.push(position.getX(i), position.getY(i), position.getZ(i));
    const count = geometry.index ? geometry.index.count : position.count;
    for (let i = 0; i < count - (count % 3); i++) faces.push(start + (geometry.index ? geometry.index.getX(i) : i));
  }
  return { positions: new Float32Array(positions), faces: new Uint32Array(faces) };
}

function readOff(text) {
  const lines = text.split("\n").map((line) => line.replace(/#.*/, "").trim()).filter(Boolean);
  const first = lines[0].replace(/^\w*OFF\s*/, "");
  const numbers = [...(first ? [first] : []), ...lines.slice(1)].map((line) => line.split(/\s+/).map(Number));
  const [vertexCount, faceCount] = numbers[0];
  const positions = numbers.slice(1, 1 + vertexCount).flatMap((row) => row.slice(0, 3));
  const faces = [];
  for (const [corners, ...ring] of numbers.slice(1 + vertexCount, 1 + vertexCount + faceCount)) {
    for (let i = 2; i < corners; i++) faces.push(ring[0], ring[i - 1], ring[i]);
  }
  return { positions: new Float32Array(positions), faces: new Uint32Array(faces) };
}

/** The mask of a silhouette: width, height, object Uint8Array (H * W) of 0 and 1. The rule of docs/conventions.md. */
export async function readSilhouette(file, threshold = 0.5) {
  let image;
  try {
    image = await createImageBitmap(file, { premultiplyAlpha: "none", colorSpaceConversion: "none" });
  } catch {
    throw new Error("expected a PNG image that this browser can read");
  }
  const { width, height } = image;
  const context = new OffscreenCanvas(width, height).getContext("2d", { willReadFrequently: true });
  context.drawImage(image, 0, 0);
  const { data } = context.getImageData(0, 0, width, height);
  const object = new Uint8Array(width * height);
  let opaque = true;
  for (let i = 3; i < data.length && opaque; i += 4) opaque = data[i] === 255;
  const levels = new Uint8Array(width * height); // the server looks at more: palettes, labels, soft alpha
  for (let i = 0; i < levels.length; i++) {
    levels[i] = opaque ? Math.max(data[4 * i], data[4 * i + 1], data[4 * i + 2]) : data[4 * i + 3];
  }
  const [least, largest] = levels.reduce(([low, high], x) => [Math.min(low, x), Math.max(high, x)], [255, 0]);
  const edge = least + threshold * (largest - least);
  for (let i = 0; i < levels.length; i++) object[i] = levels[i] > edge ? 1 : 0;
  return { width, height, object };
}
