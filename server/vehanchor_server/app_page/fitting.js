// ---- Must fit: a typed size, placed in every measured object ----

const MUST_FIT = /^(\d+\.?\d*|\.\d+)(?:[x×*](\d+\.?\d*|\.\d+))?(m|ft)?$/;
const FIT_FORMS = "Type a diameter, such as 10, or length x width, such as 12 x 5.";
const CIRCLE_CORNERS = 90;

let mustFit; // the shape, as the tool takes it; it stays when another photograph is chosen

// Read a size, in its own unit or else in that of lengths: undefined for none, null for other text.
function readMustFit(text) {
  const plain = text.toLowerCase().replaceAll(",", ".").replace(/\s/g, "");
  if (!plain) return undefined;
  const [, length, width, unit = lengthUnit()] = MUST_FIT.exec(plain) ?? [];
  const sizes = [length, width].filter(Boolean).map((side) => Number(side) * LENGTHS[unit].metres);
  if (!sizes.length || !sizes.every((size) => size > 0)) return null;
  return width === undefined ? { diameter_m: sizes[0] } : { length_m: sizes[0], width_m: sizes[1] };
}

const sidesOf = ({ diameter_m: diameter, length_m: length, width_m: width }) => (diameter ? [diameter] : [length, width]);
const typedMustFit = () => (mustFit ? sidesOf(mustFit).map(asTyped).join(" x ") : "");

function fitName(fit) {
  const sides = sidesOf(fit).map((side) => round(inUnits(side, "length")));
  return `${fit.diameter_m ? "⌀\u00a0" : ""}${sides.join("\u00a0×\u00a0")}\u00a0${unitOf("length")}`; // on one line
}

// Never rounded up to a limit that the probability does not reach.
const fitChance = ({ fit_probability: probability }) => (Math.floor(probability * 100) / 100).toFixed(2);
const fitCount = ({ n_fits_at_least: count }) => (count > 1 ? `at least ${whole(count)} in rows` : undefined);
const fitWords = (fit) => [`${fitName(fit)} fits with probability ${fitChance(fit)}`, fitCount(fit)].filter(Boolean).join(", ");

// The outline of the shape at its best place, in square pixels and in its own size; empty without one.
function fitRing(record) {
  const { fit, gsd_m_per_px: gsd } = record;
  if (!fit?.center || gsd === null) return [];
  const inSquare = squareAt(record);
  if (!fit.diameter_m) return fit.corners.map(inSquare);
  const [x, y] = inSquare(fit.center);
  const radius = fit.diameter_m / gsd / 2;
  return Array.from({ length: CIRCLE_CORNERS }, (_, i) => {
    const angle = (2 * Math.PI * i) / CIRCLE_CORNERS;
    return [x + radius * Math.cos(angle), y + radius * Math.sin(angle)];
  });
}

// Ask for the size. `place` repeats the measurements of objects with it.
function fitForm(place, tell) {
  mustFit = call.arguments.must_fit ?? mustFit;
  const size = html("input", {
    type: "text", value: typedMustFit(), placeholder: "8 or 12 x 5", autocomplete: "off",
    "aria-label": `Must fit, ${lengthName()}: a diameter, or length x width`,
  });
  size.addEventListener("change", () => {
    const wanted = readMustFit(size.value);
    size.setAttribute("aria-invalid", String(wanted === null));
    if (wanted === null) {
      tell(FIT_FORMS);
      return;
    }
    mustFit = wanted;
    size.value = typedMustFit();
    place();
  });
  const note = (words) => html("span", { class: "note" }, words);
  return html("div", { class: "group must-fit" }, note("Must fit"), size, note(unitOf("length")));
}
