// ---- All photographs: measured one after another, in a table ----

const COLUMNS = document.body.dataset.tableColumns.split(" "); // of the tables of 'vehanchor batch'
const pause = (ms) => new Promise((go) => setTimeout(go, ms));

async function measureAll() {
  leavePhotograph();
  chosen = undefined;
  showChosen(undefined);
  byId("status").hidden = true;
  byId("panel").setAttribute("aria-busy", "true");
  byId("subject").textContent = "all photographs";
  const body = html("tbody");
  const rows = []; // the record of each photograph, with its path and the reason in words
  const table = html("table", { class: "overview" }, html("thead", {}, html("tr")), body);
  const write = () => {
    const columns = ["Photograph", `Scale, ${unitOf("scale")}`, `95 % interval ${PREMISE}`, "Confidence", "Status", "Reason"];
    table.querySelector("thead tr").replaceChildren(...columns.map((words) => html("th", { scope: "col" }, words)));
    body.replaceChildren(...rows.map(tableRow));
  };
  rewriteTable = write;
  write();
  const save = button("Save table", () => download("scales.csv", csv(rows.map(columnsOf)), "text/csv"));
  byId("sections").replaceChildren(html("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": "Scales" }, table), html("div", { class: "row" }, save));
  progressed = () => {};
  const began = performance.now();
  while (allListed) await allListed;
  for (const path of [...known.keys()]) {
    let result;
    do {
      while (running.size) await pause(100); // a person's own call comes first
      if (!table.isConnected) return; // a photograph, or another table, has replaced it
      say(`Measuring ${nameOf(path)}: ${rows.length + 1} of ${known.size}${timeLeft(began, rows.length / known.size)}.`);
      result = await estimated(path);
    } while (!result);
    const record = result.isError ? { error_code: codeOf(result), error: textOf(result) } : recordOf(result);
    rows.push({ path, record, reason: reasonOf(result), contradiction: result._meta?.[PANEL_KEY]?.contradiction });
    body.append(tableRow(rows.at(-1)));
  }
  if (!table.isConnected) return;
  byId("panel").setAttribute("aria-busy", "false");
  say(`${counted(rows.length, "photograph")}: ${rows.filter(({ record }) => record.status === "ok").length} with a usable scale.`);
}

let rewriteTable = () => {};
unitsChanged.push(() => rewriteTable());

// The error, what contradicts the file, or why there is no usable scale.
function reasonOf(result) {
  if (result.isError) return textOf(result);
  const { reason, contradiction } = result._meta?.[PANEL_KEY] ?? {};
  return contradiction ?? reason ?? "";
}

function tableRow({ path, record, reason }) {
  const known = typeof record.gsd_m_per_px === "number";
  const [low, high] = [record.gsd_ci95_low_m_per_px, record.gsd_ci95_high_m_per_px];
  const scale = (value) => number(inUnits(value, "scale"));
  return html(
    "tr", {},
    html("th", { scope: "row" }, button(labelOf(path), () => choose(path), { title: path })),
    html("td", {}, known ? scale(record.gsd_m_per_px) : ""),
    html("td", {}, known && typeof low === "number" ? `${scale(low)} to ${scale(high)}` : ""),
    html("td", {}, typeof record.confidence === "number" ? record.confidence.toFixed(2) : ""),
    html("td", {}, STATUS[record.status ?? "failed"]),
    html("td", {}, reason),
  );
}

// The values of a record by column, as in vehanchor.records.flat.
const columnsOf = ({ path, record, contradiction }) => ({
  ...record, photograph: path, contradiction, tilt_deg: record.tilt?.tilt_deg, warning_codes: record.warnings?.map(({ code }) => code).join(" "),
});

// A cell that a spreadsheet would run begins with an apostrophe.
function csv(rows) {
  const cell = (value) => {
    const text = typeof value === "string" && /^[=+\-@\t\r]/.test(value) ? `'${value}` : String(value ?? "");
    return /[",\n\r]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
  };
  return [COLUMNS, ...rows.map((each) => COLUMNS.map((name) => each[name]))].map((cells) => `${cells.map(cell).join(",")}\n`).join("");
}
