// The frame of the page: which view is shown, by the address after #, and the sign-in.

import { key } from "./api.js";
import { shown } from "./dom.js";
import { List } from "./list.js";
import { One } from "./one.js";
import { Try } from "./try.js";

const main = document.querySelector("#main");
let current = null; // the view that is shown, unless it is the first, which stays
let first = null; // {root, view} of "New"

const fresh = (name) => {
  const root = document.createElement("div");
  root.append(document.querySelector(`template#${name}`).content.cloneNode(true));
  return root;
};

function show() {
  current?.close();
  current = null;
  const [, page, id] = location.hash.split("/");
  const root = page !== "refinements" ? (first?.root ?? fresh("try")) : fresh(id ? "one" : "list");
  main.replaceChildren(root);
  if (page !== "refinements") (first ??= { root, view: new Try(root) }).view.update();
  else current = id ? new One(root, decodeURIComponent(id)) : new List(root);
  for (const link of document.querySelectorAll("nav a")) {
    const here = link.hash === (page === "refinements" ? "#/refinements" : "#/");
    if (here) link.setAttribute("aria-current", "page");
    else link.removeAttribute("aria-current");
  }
  document.title = `${root.querySelector("h1").textContent.trim()} · REFINE`;
}

const dialog = document.querySelector("#sign-in-dialog");
const button = document.querySelector("#sign-in");
const input = document.querySelector("#key");

function showKey() {
  button.textContent = key.get() ? "Sign out" : "Sign in";
}

function askForKey() {
  if (dialog.open) return;
  input.value = "";
  dialog.returnValue = "";
  dialog.showModal();
}

button.addEventListener("click", () => {
  if (!key.get()) return askForKey();
  key.clear();
  showKey();
  show();
});
document.querySelector("#sign-in-cancel").addEventListener("click", () => dialog.close());
dialog.addEventListener("close", () => {
  if (dialog.returnValue !== "sign-in" || !input.value.trim()) return;
  key.set(input.value.trim());
  input.value = "";
  showKey();
  show();
});
document.addEventListener("key-needed", () => {
  key.clear();
  showKey();
  askForKey();
});

document.querySelector(".skip").addEventListener("click", (event) => {
  event.preventDefault(); // what is after # says which view is shown
  main.focus();
});
addEventListener("hashchange", () => {
  show();
  main.focus({ preventScroll: true });
  scrollTo(0, 0);
});
for (const kind of ["dragover", "drop"]) addEventListener(kind, (event) => event.preventDefault()); // a file must not replace the page
shown(document.querySelector("noscript"), false);
showKey();
show();
