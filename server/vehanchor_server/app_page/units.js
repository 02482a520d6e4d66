// ---- Units: what a person reads and types; the server speaks metres, and so do saved tables ----

const LENGTHS = { m: { name: "metres", metres: 1 }, ft: { name: "feet", metres: 0.3048 } };
const SCALES = { "m/px": 1, "cm/px": 0.01 }; // metres per pixel
const FIELD_DIGITS = 4; // of a length that is converted into a field

const lengthUnit = () => byId("lengths").value;
const lengthName = () => LENGTHS[lengthUnit()].name;

// The unit of a quantity, and its size in the server's units.
const UNITS = {
  length: () => [lengthUnit(), LENGTHS[lengthUnit()].metres],
  area: () => [`${lengthUnit()}²`, LENGTHS[lengthUnit()].metres ** 2],
  scale: () => [byId("scales").value, SCALES[byId("scales").value]],
};
const unitOf = (quantity) => UNITS[quantity]()[0];
const inUnits = (value, quantity) => value / UNITS[quantity]()[1];
const sized = (value, quantity) => `${number(inUnits(value, quantity))} ${unitOf(quantity)}`;

function interval(low, high, quantity) {
  if (low === null || high === null) return undefined;
  return `95 %: ${number(inUnits(low, quantity))} to ${sized(high, quantity)}`;
}

// Typed lengths in metres, and metres as people type them.
const typedMetres = (text) => Number(text) * LENGTHS[lengthUnit()].metres;
const asTyped = (metres) => Number(inUnits(metres, "length").toPrecision(FIELD_DIGITS));

const unitsChanged = []; // what shows lengths or scales, besides the current result
byId("units").addEventListener("change", () => {
  for (const renew of unitsChanged) renew();
  if (call.result) show(call.result);
});
