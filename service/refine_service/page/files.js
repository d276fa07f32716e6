// The files of a request, read in the browser: meshes as triangles, silhouettes as masks.

import { objectOf } from "./mask.js";
import { GLTFLoader, OBJLoader, PLYLoader, STLLoader, Vector3 } from "./vendor/three.js";

/** A file that the server reads and this page cannot show. */
export class Unshown extends Error {}

/** The triangles of a mesh file: positions Float32Array (V * 3), faces Uint32Array (F * 3). Throws an Unshown, or an Error in words. */
export async function readMesh(file) {
  let read;
  try {
    read = await parse(file);
  } catch (error) {
    if (error instanceof Unshown) throw error;
    if (/DRACOLoader/.test(error.message)) throw new Unshown("compressed with Draco");
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
  if (head.startsWith("PK\x03\x04")) throw new Unshown("an archive");
  if (head.startsWith("#binvox")) throw new Unshown("a voxel grid");
  if (/^ply\s/.test(head)) {
    if (!/element\s+(face|tristrips)\s+[1-9]/.test(head.split("end_header")[0])) throw new Unshown("points");
    return ofGeometries([new PLYLoader().parse(bytes)]);
  }
  if (suffix === "obj") return ofScene(new OBJLoader().parse(text()));
  if (suffix === "stl") return ofGeometries([new STLLoader().parse(bytes)]);
  if (suffix === "off" || /^\w*OFF/.test(head)) return readOff(text());
  throw new Error("expected a GLB, glTF, OBJ, PLY, STL, OFF, binvox, NPZ or ZIP file");
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
  const head = new TextDecoder("latin1").decode(await file.slice(0, 4).arrayBuffer());
  if (head === "II*\0" || head === "MM\0*") throw new Unshown("a TIFF");
  let image;
  try {
    const plain = { premultiplyAlpha: "none", colorSpaceConversion: "none", imageOrientation: "from-image" };
    image = await createImageBitmap(file, plain);
  } catch {
    throw new Error("expected a PNG, JPEG, WebP, TIFF or BMP image");
  }
  const { width, height } = image;
  const context = new OffscreenCanvas(width, height).getContext("2d", { willReadFrequently: true });
  context.drawImage(image, 0, 0);
  const object = objectOf(context.getImageData(0, 0, width, height), threshold);
  if (object === null) throw new Unshown("of one level in this browser, which sees 8 bits and no palette");
  return { width, height, object };
}
