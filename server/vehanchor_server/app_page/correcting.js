// ---- Corrections: vehicles that a person drops or adds ----

const NEAR_PX = 6; // screen pixels beside a box that still pick it

const numberOf = (vehicle) => vehicle[6];
const isAdded = (vehicle) => Boolean(vehicle[7]);
const boxAlong = ([[x1, y1], [x2, y2]]) => {
  const length = Math.hypot(x2 - x1, y2 - y1);
  const degrees = (Math.atan2(y2 - y1, x2 - x1) * 180) / Math.PI;
  return [(x1 + x2) / 2, (y1 + y2) / 2, length, length / call.corrections.lengthOverWidth, degrees, 1];
};

// Read the corrections of the call, once, and the vehicles of its result.
function readCorrections(record, drawing) {
  const { drop, add } = call.arguments ?? {};
  const [across, down] = callerUnits(record);
  call.corrections ??= {
    drop: new Set(numbersIn(drop)),
    add: (add ?? []).map(({ x1, y1, x2, y2 }) => ({ ends: [[x1 * across, y1 * down], [x2 * across, y2 * down]] })),
    boxes: new Map(), // of all detections, also of dropped ones
    lengthOverWidth: Infinity, // of the detector's boxes; until it is known, an added vehicle is a line
  };
  call.corrections.lengthOverWidth = drawing?.length_over_width ?? call.corrections.lengthOverWidth;
  const { boxes, add: added } = call.corrections;
  const vehicles = drawing?.vehicles ?? [];
  call.corrections.detected = vehicles.filter((each) => !isAdded(each));
  for (const each of call.corrections.detected) boxes.set(numberOf(each), each);
  const found = vehicles.filter(isAdded);
  added.forEach((each, i) => { each.box = found[i] ?? boxAlong(each.ends); });
}

// Vehicles as corrected: each has a box, its state in the picture, and a number or an entry of `add`.
function correctedVehicles() {
  const { drop, add, boxes, detected } = call.corrections;
  const gone = [...drop].filter((n) => boxes.has(n) && !detected.some((each) => numberOf(each) === n)).map((n) => boxes.get(n));
  const measured = (box) => (box[5] ? "kept" : "outlier");
  return [
    ...[...detected, ...gone].map((box) => {
      const n = numberOf(box);
      return { box, number: n, state: drop.has(n) ? "removed" : measured(box) };
    }),
    ...add.map((added) => ({ box: added.box, added, state: added.box[5] ? "stated" : "outlier" })),
  ];
}

// The vehicle at a place, the nearest of several.
function vehicleAt([x, y], margin) {
  const off = ({ box: [cx, cy, length, width, degrees] }) => {
    const [cos, sin] = [Math.cos((degrees * Math.PI) / 180), Math.sin((degrees * Math.PI) / 180)];
    const [along, across] = [(x - cx) * cos + (y - cy) * sin, (y - cy) * cos - (x - cx) * sin];
    return Math.abs(along) <= length / 2 + margin && Math.abs(across) <= width / 2 + margin ? Math.hypot(along, across) : Infinity;
  };
  return correctedVehicles().filter((each) => off(each) < Infinity).sort((one, other) => off(one) - off(other))[0];
}

const vehiclesWithin = ([[x1, y1], [x2, y2]]) => correctedVehicles().filter(({ box: [x, y] }) =>
  (x - x1) * (x - x2) <= 0 && (y - y1) * (y - y2) <= 0);

// Drop vehicles; if all of them are dropped, take it back. Say what was done.
function dropVehicles(vehicles) {
  const { drop } = call.corrections;
  const numbers = vehicles.filter((each) => each.number).map((each) => each.number);
  const added = vehicles.filter((each) => each.added).map((each) => each.added);
  const isBack = numbers.length > 0 && numbers.every((n) => drop.has(n));
  for (const n of numbers) isBack ? drop.delete(n) : drop.add(n);
  call.corrections.add = call.corrections.add.filter((each) => !added.includes(each));
  const who = numbers.length === 1 && !added.length ? `Vehicle ${numbers[0]}` : counted(numbers.length + added.length, "vehicle");
  return `${who} ${isBack ? "as found" : "dropped"}.`;
}

const numbersIn = (text) => (text ?? "").split(/[\s,]+/).filter(Boolean).flatMap((part) => {
  const [first, last = first] = part.split("-").map(Number);
  return Array.from({ length: last - first + 1 }, (_, i) => first + i);
});

function withCorrections(record, { drop: _, add: __, ...asked }) {
  const { drop, add } = call.corrections;
  if (drop.size) asked.drop = [...drop].sort((a, b) => a - b).join(",");
  if (add.length) asked.add = add.map(({ ends }) => lineOf(record, ends));
  return asked;
}

// What was corrected, a button to measure with it, and one to take it all back.
function correctionRow(record, tell, changed) {
  const summary = html("span", {}, "");
  const measure = button("Measure again", () => measureAgain(call.arguments, tell));
  const discard = button("Take all back", () => {
    Object.assign(call.corrections, { drop: new Set(), add: [] });
    changed();
    tell("All corrections taken back.");
  });
  const row = html("div", { class: "row asked", hidden: true }, summary, measure, discard);
  const given = () => JSON.stringify(withCorrections(record, {}));
  const applied = given();
  const refresh = () => {
    const counts = { added: call.corrections.add.length, dropped: call.corrections.drop.size };
    const parts = Object.entries(counts).filter(([, n]) => n).map(([kind, n]) => `${whole(n)} ${kind}`);
    summary.textContent = `Vehicles by hand: ${parts.join(", ") || "none"}`;
    measure.hidden = given() === applied;
    discard.hidden = !parts.length;
    row.hidden = measure.hidden && discard.hidden;
  };
  return { row, refresh };
}
