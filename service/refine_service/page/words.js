// The numbers of a refinement in words.

import { fixed, percent, seconds, short } from "./dom.js";

const OUTCOMES = {
  refined: "The mesh was moved as a whole and then bent by the network.",
  fitted: "The mesh was moved and scaled as a whole; what the network added was not better.",
  kept: "The mesh is returned as it came.",
};

const place = ({ queue_position: ahead }) => (ahead ? `Waiting; ${ahead} ahead of it` : "Waiting for a free worker");
const end = ({ eta_s: left }) => (left == null ? "" : `, done in about ${seconds(left)}`);

const STATES = {
  queued: (refinement) => `${place(refinement)}${end(refinement)}.`,
  running: () => "Running.",
  cancelling: () => "Stopping.",
  succeeded: () => "Done.",
  failed: () => "It failed.",
  cancelled: () => "It was cancelled.",
  expired: () => "Its time is over; its files were removed.",
};

/** A sentence about where a refinement is. */
export const stateWords = (refinement) => (STATES[refinement.state] ?? (() => `It is ${refinement.state}.`))(refinement);

const number = (count) => count.toLocaleString("en");

/** Sentences about what report.json says of a refinement with these options. */
export function reportWords(report, { preset, seed }) {
  const { silhouette_iou: iou, outcome, mirror_plane: symmetry, camera_correction: correction, mesh_counts: mesh } = report;
  const told = [];
  if (outcome) told.push(OUTCOMES[outcome] ?? `Outcome: ${outcome}.`);
  told.push(
    iou.after > iou.before
      ? `It agrees better with its silhouette: the 2D IoU went from ${fixed(iou.before, 3)} to ${fixed(iou.after, 3)}.`
      : `The 2D IoU with its silhouette was ${fixed(iou.before, 3)} and is ${fixed(iou.after, 3)}.`,
  );
  if (symmetry) {
    const normal = symmetry.normal.map((x) => fixed(x, 2)).join(", ");
    const error = symmetry.error === null ? "was given" : `was found; the coarse mesh misses its mirror image by ${percent(symmetry.error)} of its size on average`;
    told.push(`The mirror plane with the normal (${normal}) and the offset ${short(symmetry.offset)} ${error}.`);
  } else if (symmetry === null) {
    told.push("No mirror plane was found, so symmetry had no say.");
  }
  if (correction) told.push(`The camera was turned by ${short(correction.turn_degrees)}° to fit.`);
  if (mesh) {
    told.push(`The mesh has ${number(mesh.vertices)} vertices and ${number(mesh.faces)} faces.`);
    if (mesh.refined_vertices > mesh.vertices) told.push(`It was subdivided to ${number(mesh.refined_vertices)} vertices.`);
    if (mesh.optimised_vertices < mesh.vertices) told.push(`One of ${number(mesh.optimised_vertices)} vertices was optimised, and the mesh followed it.`);
    if (mesh.removed_faces) told.push(`${number(mesh.removed_faces)} faces that cover holes of the silhouette were removed.`);
  }
  if (report.best_iteration > 0 && outcome === "refined") told.push(`The best iterate was number ${report.best_iteration}.`);
  told.push(`It took ${seconds(report.seconds)} on ${report.device}, with preset ${preset} and seed ${seed}.`);
  return told;
}

/** What a confidence says, for the legend: a distance; see docs/files.md. */
export function confidenceWords(report) {
  const cost = report?.config?.confidence_cost;
  const meaning = "How near the mirror image of a place comes to the mesh. It says nothing about how right the surface is.";
  if (report?.mirror_plane === null) return `${meaning} Here no mirror plane was found: 0 everywhere.`;
  if (!cost || report.config.learn_confidence) return `${meaning} 1: mirrored, 0: no mirror image.`;
  const away = (confidence) => percent(Math.sqrt(3 * cost * Math.sqrt(1 / confidence - 1)));
  return `${meaning} 0.9: ${away(0.9)} of the object's size away; 0.5: ${away(0.5)}; 0.1: ${away(0.1)}.`;
}
