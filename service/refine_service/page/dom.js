// Small help with the document: elements, numbers, sizes and times for people.

/** A new element with properties and children (elements or text). */
export function element(tag, properties = {}, ...children) {
  const made = Object.assign(document.createElement(tag), properties);
  made.append(...children);
  return made;
}

export const shown = (node, is = true) => node.toggleAttribute("hidden", !is);
export const fixed = (value, digits = 2) => value.toFixed(digits);
export const percent = (value) => `${fixed(100 * value, 1)} %`;

/** Three significant digits, without trailing zeros. */
export const short = (value) => String(Number(value.toPrecision(3)));

export function bytes(count) {
  const power = Math.min(3, Math.floor(Math.log(Math.max(count, 1)) / Math.log(1024)));
  return `${short(count / 1024 ** power)} ${["B", "KiB", "MiB", "GiB"][power]}`;
}

export function seconds(count) {
  if (count < 90) return `${count < 9.95 ? fixed(count, 1) : Math.round(count)} s`;
  return count < 5400 ? `${Math.round(count / 60)} min` : `${short(count / 3600)} h`;
}

const clock = new Intl.DateTimeFormat(undefined, { dateStyle: "medium", timeStyle: "short" });
export const time = (text) => element("time", { dateTime: text }, clock.format(new Date(text)));

/** `work` at most once per frame, with the latest state. */
export function oncePerFrame(work) {
  let asked = false;
  return () => {
    if (asked) return;
    asked = true;
    requestAnimationFrame(() => {
      asked = false;
      work();
    });
  };
}
