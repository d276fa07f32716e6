// The caller's refinements, newest first.

import { address, call, getJson } from "./api.js";
import { bytes, element, fixed, seconds, shown, time } from "./dom.js";

const COLUMNS = ["Refinement", "State", "Preset", "2D IoU", "Submitted", "Took", "Size", "Kept until"];

/** The view of the list in `root`. */
export class List {
  constructor(root) {
    this.root = root;
    this.find = (selector) => root.querySelector(selector);
    this.find(".more").addEventListener("click", () => this.load());
    this.load();
  }

  close() {}

  async load() {
    try {
      const cursor = this.cursor ? `&cursor=${encodeURIComponent(this.cursor)}` : "";
      const page = await getJson(`v1/refinements?limit=20${cursor}`);
      this.cursor = page.next_cursor;
      this.find("tbody").append(...page.refinements.map((refinement) => this.row(refinement)));
      this.showWhatIsThere();
    } catch (error) {
      this.find(".error").textContent = error.message;
    }
  }

  showWhatIsThere() {
    const some = this.find("tbody").childElementCount > 0;
    shown(this.find("table"), some);
    shown(this.find(".empty"), !some);
    shown(this.find(".more"), Boolean(this.cursor));
  }

  row(refinement) {
    const { id, state, options, silhouette_iou: iou, started_at: started, finished_at: finished } = refinement;
    const size = refinement.artifacts.reduce((sum, artifact) => sum + artifact.size_bytes, 0);
    const cells = [
      element("a", { href: `#/refinements/${id}` }, id.slice(0, 8)),
      element("span", { className: `badge ${state}` }, state),
      options.preset,
      iou ? `${fixed(iou.before)} → ${fixed(iou.after)}` : "",
      time(refinement.created_at),
      started && finished ? seconds((new Date(finished) - new Date(started)) / 1000) : "",
      size ? bytes(size) : "",
      time(refinement.expires_at),
    ].map((content, i) => {
      const cell = element(i ? "td" : "th", i ? {} : { scope: "row" }, content);
      cell.dataset.label = COLUMNS[i];
      return cell;
    });
    const remove = element("button", { type: "button", className: "quiet", ariaLabel: `Delete refinement ${id.slice(0, 8)}` }, "Delete");
    const row = element("tr", {}, ...cells, element("td", {}, remove));
    remove.addEventListener("click", () => this.remove(id, row));
    return row;
  }

  async remove(id, row) {
    if (!confirm(`Delete refinement ${id.slice(0, 8)} and its files?`)) return;
    try {
      await call(address(id), { method: "DELETE" });
      row.remove();
      this.showWhatIsThere();
    } catch (error) {
      this.find(".error").textContent = error.message;
    }
  }
}
