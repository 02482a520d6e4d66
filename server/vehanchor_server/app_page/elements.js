// ---- Elements ----

const byId = (id) => document.getElementById(id);
const SVG = "http://www.w3.org/2000/svg";

function element(namespace, name, attributes, children) {
  const made = namespace ? document.createElementNS(namespace, name) : document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (key === "on") for (const [event, act] of Object.entries(value)) made.addEventListener(event, act);
    else if (key === "width_share") made.style.width = `${100 * value}%`;
    else if (key === "left_share") made.style.left = `${100 * value}%`;
    else if (value !== undefined && value !== false) made.setAttribute(key, value === true ? "" : value);
  }
  made.append(...children.filter((child) => child !== undefined && child !== null));
  return made;
}
const html = (name, attributes = {}, ...children) => element(null, name, attributes, children);
const svg = (name, attributes = {}, ...children) => element(SVG, name, attributes, children);

// Steps of 1, 2 or 5 times a power of ten.
function roundSteps(span, most) {
  const raw = span / most;
  const power = 10 ** Math.floor(Math.log10(raw));
  return [1, 2, 5, 10].map((m) => m * power).find((step) => step >= raw * (1 - 1e-9));
}

// ---- Numbers and words ----

const threeDigits = new Intl.NumberFormat("en", { minimumSignificantDigits: 3, maximumSignificantDigits: 3 });
const roundNumber = new Intl.NumberFormat("en", { maximumSignificantDigits: 3 });
const number = (value) => threeDigits.format(value); // measured: its zeros say how exactly
const round = (value) => roundNumber.format(value); // chosen: ticks and scale bars
const whole = (value) => new Intl.NumberFormat("en").format(value);
const counted = (n, noun) => `${whole(n)} ${noun}${n === 1 ? "" : "s"}`;
const interval = (low, high, unit) =>
  low === null || high === null ? undefined : `95 %: ${number(low)} to ${number(high)} ${unit}`;

const STATUS = {
  ok: { words: "Safe to use", mark: "M2.5 8.5 6 12 13.5 4" },
  low_confidence: { words: "Low confidence: do not use", mark: "M8 2 15 14H1ZM8 6.5v4M8 12v.6" },
  no_scale: { words: "No metric scale", mark: "M3 3l10 10M13 3 3 13" },
  failed: { words: "No result", mark: "M3 3l10 10M13 3 3 13" },
};

function say(text) {
  byId("sentence").textContent = text;
}

function flag(status) {
  const { words, mark } = STATUS[status];
  const icon = svg("path", {
    d: mark, fill: "none", stroke: "currentColor", "stroke-width": 1.8, "stroke-linecap": "round",
    "stroke-linejoin": "round",
  });
  const chip = byId("status");
  chip.className = `status ${status}`;
  chip.replaceChildren(svg("svg", { viewBox: "0 0 16 16", "aria-hidden": "true" }, icon), words);
  chip.hidden = false;
}

function fail(text) {
  flag("failed");
  say(text);
  byId("sections").replaceChildren();
  byId("panel").setAttribute("aria-busy", "false");
}
