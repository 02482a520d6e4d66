// ---- The whole ----

const isArea = (record) => "mask_area_px" in record;
const ERROR_CODE = /^\w+: /; // for programs
const textOf = (result) => (result.content ?? []).filter((part) => part.type === "text")
  .map((part) => part.text).join(" ").replace(result.isError ? ERROR_CODE : "", "");
const codeOf = (result) => (result.content ?? []).map(({ text }) => /^\w+(?=: )/.exec(text ?? "")?.[0]).find(Boolean) ?? "internal_error";
const scaleOf = (record) => (isArea(record) ? record.estimate : record);

// The whole record, wherever a short answer has it; the first of several.
const recordOf = (result) =>
  result._meta?.[PANEL_KEY]?.record ?? result.structuredContent?.measurements?.[0] ?? result.structuredContent;

function show(result) {
  const record = recordOf(result);
  if (result.isError) return fail(textOf(result));
  byId("panel").setAttribute("aria-busy", "false");
  say(result._meta?.[PANEL_KEY]?.sentence ?? textOf(result));
  if (!record) return byId("sections").replaceChildren();
  const scale = scaleOf(record);
  byId("subject").textContent = isArea(record) ? "area of an object" : "metric scale";
  flag(record.status);
  byId("units").hidden = false;
  const sections = [
    readings(record),
    warningSection(record),
    pictureSection(record, result),
    scale ? rulersSection(scale) : undefined,
    detailsSection(record),
  ];
  byId("sections").replaceChildren(...sections.filter(Boolean));
  shown(scale);
}
