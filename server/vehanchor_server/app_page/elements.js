// ---- Elements ----

const byId = (id) => document.getElementById(id);
const SVG = "http://www.w3.org/2000/svg";

function element(namespace, name, attributes, children) {
  const made = namespace ? document.createElementNS(namespace, name) : document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (key === "on") for (const [event, act] of Object.entries(value)) made.addEventListener(event, act);
    else if (value !== undefined && value !== false) made.setAttribute(key, value === true ? "" : value);
  }
  made.append(...children.filter((child) => child !== undefined && child !== null));
  return made;
}
const html = (name, attributes = {}, ...children) => element(null, name, attributes, children);
const button = (words, act, attributes = {}) => html("button", { type: "button", ...attributes, on: { click: act } }, words);
const svg = (name, attributes = {}, ...children) => element(SVG, name, attributes, children);

// The next number that is 1, 2 or 5 times a power of ten.
function roundUp(least) {
  const power = 10 ** Math.floor(Math.log10(least));
  return [1, 2, 5, 10].map((m) => m * power).find((value) => value >= least * (1 - 1e-9));
}

// ---- Numbers and words ----

const threeDigits = new Intl.NumberFormat("en", { minimumSignificantDigits: 3, maximumSignificantDigits: 3 });
const roundNumber = new Intl.NumberFormat("en", { maximumSignificantDigits: 3 });
const number = (value) => threeDigits.format(value); // measured: its zeros say how exactly
const round = (value) => roundNumber.format(value); // chosen: scale bars
const whole = (value) => new Intl.NumberFormat("en").format(value);
const counted = (n, noun) => `${whole(n)} ${noun}${n === 1 ? "" : "s"}`;
const withCapital = (words) => words[0].toUpperCase() + words.slice(1);
const PREMISE = document.body.dataset.intervalPremise; // of the interval of a scale

const STATUS = { ok: "Safe to use", low_confidence: "Low confidence: do not use", no_scale: "No metric scale", failed: "No result" };

// The end of work that began at a time, in words; nothing in its first seconds.
function timeLeft(began, share) {
  const seconds = (performance.now() - began) / 1000;
  const left = (seconds * (1 - share)) / share;
  if (seconds < 3 || !Number.isFinite(left)) return "";
  return left < 90 ? `; about ${Math.ceil(left)} s left` : `; about ${Math.ceil(left / 60)} min left`;
}

function say(text) {
  byId("sentence").textContent = text;
}

function flag(status) {
  const chip = byId("status");
  chip.className = `status ${status}`;
  chip.textContent = STATUS[status];
  chip.hidden = false;
}

function fail(text) {
  flag("failed");
  say(text);
  byId("sections").replaceChildren();
  byId("panel").setAttribute("aria-busy", "false");
}
