// Cameras as docs/conventions.md says: a CameraSpec becomes one form, the camera of the engine, and a three.js camera.

import { Camera, Matrix4 } from "./vendor/three.js";

const AXES = { opencv: [1, 1, 1], opengl: [1, -1, -1], pytorch3d: [-1, -1, 1] }; // of the camera, to OpenCV's
const radians = (degrees) => (degrees * Math.PI) / 180;

/**
 * The one form of a CameraSpec for an image of width x height pixels: `matrix`, a Matrix4 from the world to OpenCV's
 * camera axes, fx, fy, cx, cy in pixels, width, height, orthographic. Throws an Error in words.
 */
export function readCamera(spec, width, height) {
  const ofAngle = (degrees) => {
    if (!(degrees >= 0.001 && degrees < 180)) throw new Error(`expected a field of view from 0.001 to below 180, got ${degrees}`);
    const f = (0.5 * height) / Math.tan(radians(degrees) / 2);
    return { fx: f, fy: f, cx: width / 2, cy: height / 2 };
  };
  if (spec.type === "look_at") {
    return { matrix: lookAt(spec), ...ofAngle(spec.fov_y_degrees ?? 60), width, height, orthographic: false };
  }
  if (spec.type !== "matrix" || !AXES[spec.convention]) {
    throw new Error("expected type look_at or matrix, and a matrix with the convention opencv, opengl or pytorch3d");
  }
  const rows = (spec.world_to_camera ?? spec.camera_to_world ?? []).flat();
  if (rows.length !== 16 || !rows.every(Number.isFinite)) throw new Error(`expected 16 numbers, got ${rows.length}`);
  if ([0, 0, 0, 1].some((wanted, i) => Math.abs(rows[12 + i] - wanted) > 1e-6)) {
    throw new Error(`expected the last row 0 0 0 1, got ${rows.slice(12).join(" ")}`);
  }
  const matrix = new Matrix4().set(...rows);
  const scales = [0, 1, 2].map((i) => Math.hypot(rows[i], rows[4 + i], rows[8 + i]));
  if (scales.some((scale) => Math.abs(scale - 1) > 1e-3)) throw new Error("expected a rotation without a scale");
  if (spec.camera_to_world) matrix.invert();
  matrix.premultiply(new Matrix4().makeScale(...AXES[spec.convention]));
  const lens = spec.intrinsics ?? ofAngle(spec.fov_y_degrees);
  const { fx, fy, cx, cy } = lens;
  if (![fx, fy, cx, cy].every(Number.isFinite)) throw new Error("expected four numbers: fx fy cx cy");
  return { matrix, fx, fy, cx, cy, width, height, orthographic: spec.projection === "orthographic" };
}

function lookAt({ azimuth_degrees: azimuth, elevation_degrees: elevation, distance }) {
  if (![azimuth, elevation, distance].every(Number.isFinite)) throw new Error("expected numbers for azimuth, elevation and distance");
  if (!(distance > 0)) throw new Error(`expected a distance above 0, got ${distance}`);
  if (Math.abs(elevation) > 90) throw new Error(`expected an elevation from -90 to 90, got ${elevation}`);
  const [a, e] = [radians(azimuth), radians(elevation)];
  const [x, y, z] = [-Math.cos(e) * Math.sin(a), -Math.sin(e), -Math.cos(e) * Math.cos(a)]; // forward
  const [u, w] = [Math.cos(a), -Math.sin(a)]; // right is (u, 0, w), down is forward x right
  return new Matrix4().set(u, 0, w, 0, y * w, z * u - x * w, -y * u, 0, x, y, z, distance, 0, 0, 0, 1);
}

/** The other readings of a matrix: its spec with each other convention and direction. */
export function otherReadings(spec) {
  const rows = spec.world_to_camera ?? spec.camera_to_world;
  const { world_to_camera: _, camera_to_world: __, ...rest } = spec;
  return Object.keys(AXES)
    .flatMap((convention) => ["world_to_camera", "camera_to_world"].map((direction) => ({ ...rest, convention, [direction]: rows })))
    .filter((other) => other.convention !== spec.convention || !(Object.keys(other).find((name) => name in spec && name.includes("_to_"))));
}

/** The same camera with an image of another size. */
export function resized(camera, width, height) {
  const [x, y] = [width / camera.width, height / camera.height];
  return { ...camera, fx: camera.fx * x, cx: camera.cx * x, fy: camera.fy * y, cy: camera.cy * y, width, height };
}

/** Where the camera stands in the world: column 4 of the inverse. */
export const standsAt = (camera) => camera.matrix.clone().invert().elements.slice(12, 15);

/**
 * A three.js camera that draws the image of `camera` into `view`, {x, y, width, height} in pixels of a canvas of `size`
 * [width, height]; `sphere` {center, radius} is what must be between near and far.
 */
export function threeCamera(camera, sphere, view, size) {
  const depth = sphere.center.clone().applyMatrix4(camera.matrix).z;
  const far = Math.max(depth + 1.01 * sphere.radius, 1e-6);
  const near = camera.orthographic ? depth - 1.01 * sphere.radius : Math.max(depth - 1.01 * sphere.radius, far * 1e-4);
  const [sx, sy] = [view.width / camera.width, view.height / camera.height];
  const [a, b] = [(2 * camera.fx * sx) / size[0], (2 * camera.fy * sy) / size[1]];
  const c = (2 * (camera.cx * sx + view.x)) / size[0] - 1;
  const d = 1 - (2 * (camera.cy * sy + view.y)) / size[1];
  const made = new Camera();
  if (camera.orthographic) {
    made.projectionMatrix.set(a, 0, 0, c, 0, b, 0, d, 0, 0, -2 / (far - near), -(far + near) / (far - near), 0, 0, 0, 1);
  } else {
    made.projectionMatrix.set(a, 0, -c, 0, 0, b, -d, 0, 0, 0, -(far + near) / (far - near), (-2 * far * near) / (far - near), 0, 0, -1, 0);
  }
  made.projectionMatrixInverse.copy(made.projectionMatrix).invert();
  made.matrixAutoUpdate = made.matrixWorldAutoUpdate = false;
  made.matrixWorldInverse.makeScale(1, -1, -1).multiply(camera.matrix); // OpenGL's camera axes
  made.matrixWorld.copy(made.matrixWorldInverse).invert();
  return made;
}
