// ---- Facts: region, height and focal length, stated by a person ----

const countryNames = new Intl.DisplayNames("en", { type: "region" });
for (const option of byId("region").options) {
  if (/^[A-Z]{2}$/.test(option.value)) option.textContent = countryNames.of(option.value);
}

let heightM; // camera height, metres, whatever the unit of its field
const heightField = byId("height");
const HEIGHTS_M = [heightField.min, heightField.max].map(Number);
heightField.addEventListener("input", () => { heightM = heightField.value ? typedMetres(heightField.value) : undefined; });
function showHeight() {
  byId("height-unit").textContent = unitOf("length");
  const [least, most] = HEIGHTS_M.map(asTyped);
  heightField.min = least;
  heightField.max = most;
  heightField.value = heightM === undefined ? "" : asTyped(heightM);
}
unitsChanged.push(showHeight);

const FACTS = ["region", "height_m", "height_basis", "focal_35mm"];
const factsOf = (asked) => FACTS.map((name) => asked[name]).join();

function statedFacts() {
  const facts = byId("region").value ? { region: byId("region").value } : {};
  if (!heightM) return facts; // the others say more about it
  const focal = Number(byId("focal").value);
  return {
    ...facts, height_m: heightM,
    ...(byId("surveyed").checked ? { height_basis: "measured" } : {}), ...(focal ? { focal_35mm: focal } : {}),
  };
}

const withFacts = (asked) => ({
  ...Object.fromEntries(Object.entries(asked).filter(([name]) => !FACTS.includes(name))), ...statedFacts(),
});

// Show the facts of a call that somebody else has made.
function fillInFacts(asked) {
  byId("region").value = asked.region ?? "";
  heightM = asked.height_m ?? undefined;
  showHeight();
  byId("focal").value = asked.focal_35mm ?? "";
  byId("surveyed").checked = asked.height_basis === "measured";
}

const measureWithFacts = () => measureAgain(withFacts(call.arguments), say);

const offerFacts = () => { byId("restate").hidden = !call.arguments || factsOf(call.arguments) === factsOf(statedFacts()); };
byId("facts").addEventListener("input", offerFacts);
byId("restate").addEventListener("click", () => {
  if ([...byId("facts").querySelectorAll("input")].every((input) => input.reportValidity())) factsStated();
});
