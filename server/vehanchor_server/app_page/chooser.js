// ---- Photographs: the folder's and dropped ones ----

const known = new Map(); // by path: the button, and the result if any
const NAME_END = 12;
let chosen;
let nextPage;

const nameOf = (path) => path.split(/[\\/]/).pop();
const count = () => {
  byId("count").textContent = counted(known.size, "photograph");
};

function listPhotograph(path, first = false) {
  if (known.has(path)) return;
  const mark = html("span", { class: "mark", "aria-hidden": "true" });
  const name = nameOf(path);
  const cut = Math.max(name.length - NAME_END, 0); // shortened in the middle: names of one flight differ at their ends
  const words = html("span", { class: "name" }, html("span", {}, name.slice(0, cut)), html("span", {}, name.slice(cut)));
  const button = html("button", { type: "button", title: path, on: { click: () => choose(path) } }, mark, words);
  known.set(path, { button, mark });
  byId("photographs")[first ? "prepend" : "append"](html("li", {}, button));
  count();
}

async function listPage(page) {
  byId("more").hidden = true;
  nextPage = undefined;
  const { structuredContent: listed } = await request("tools/call", { name: "view_image", arguments: { page } });
  listed.images.forEach((path) => listPhotograph(path));
  if (!listed.next_page) return;
  nextPage = listed.next_page;
  byId("more").hidden = false;
  byId("more").onclick = () => listPage(nextPage);
}

async function choose(path) {
  leave();
  chosen = path;
  for (const [each, { button }] of known) button.setAttribute("aria-current", String(each === path));
  const region = byId("region").value;
  call.arguments = { image: { kind: "path", path }, ...(region ? { region } : {}) };
  call.tool = "estimate_gsd";
  call.measured = [];
  byId("sections").replaceChildren();
  byId("status").hidden = true;
  byId("panel").setAttribute("aria-busy", "true");
  const entry = known.get(path);
  const bar = html("progress", { max: "100", "aria-label": "Progress of the measurement" });
  byId("sections").replaceChildren(bar);
  progressed = (percent, message) => {
    if (chosen !== path || !bar.isConnected) return;
    bar.value = percent;
    say(`${nameOf(path)}: ${message}.`);
  };
  say(`Measuring ${nameOf(path)}.`);
  const result = await estimated(path, region);
  if (!result || chosen !== path) return;
  call.result = result;
  show(result);
}

// The estimate of a photograph, made once for a region; undefined if the call was left.
async function estimated(path, region) {
  const entry = known.get(path);
  if (entry.result?.region === region) return entry.result.result;
  const asked = { image: { kind: "path", path }, ...(region ? { region } : {}) };
  let result;
  try {
    result = await request("tools/call", { name: "estimate_gsd", arguments: asked });
  } catch (error) {
    if (error.name === "AbortError") return undefined;
    result = { isError: true, content: [{ type: "text", text: error.message }] };
  }
  if (!result.isError) entry.result = { region, result };
  entry.mark.className = `mark ${result.isError ? "failed" : result.structuredContent.status}`;
  const jpeg = result._meta?.[PANEL_KEY]?.picture_jpeg;
  if (jpeg && !entry.button.querySelector("img")) entry.mark.after(html("img", { alt: "", src: `data:image/jpeg;base64,${jpeg}` }));
  return result;
}

async function take(files) {
  let first;
  for (const file of files) {
    say(`Reading ${file.name}.`);
    const response = await fetch(`photographs?name=${encodeURIComponent(file.name)}`, {
      method: "POST", headers: { "content-type": "application/octet-stream" }, body: file,
    }).catch(() => undefined);
    if (!response?.ok) {
      fail(response ? await response.text() : "The program has ended. Start 'vehanchor view' again.");
      continue;
    }
    const { path } = await response.json();
    listPhotograph(path, true);
    first ??= path;
  }
  if (first) await choose(first);
}

// ---- All photographs: measured one after another, in a table ----

const FIELDS = ["status", "gsd_m_per_px", "gsd_ci95_low_m_per_px", "gsd_ci95_high_m_per_px", "confidence", "n_vehicles"];
const pause = (ms) => new Promise((go) => setTimeout(go, ms));

async function measureAll() {
  leave();
  chosen = undefined;
  for (const { button } of known.values()) button.setAttribute("aria-current", "false");
  byId("status").hidden = true;
  byId("panel").setAttribute("aria-busy", "true");
  byId("subject").textContent = "all photographs";
  const region = byId("region").value;
  const body = html("tbody");
  const rows = [];
  const head = ["Photograph", "Metres per pixel", "95 % interval", "Confidence", "Status"].map((words) => html("th", { scope: "col" }, words));
  const table = html("table", { class: "overview" }, html("thead", {}, html("tr", {}, ...head)), body);
  const save = html("button", { type: "button", on: { click: () => download("scales.csv", csv(rows), "text/csv") } }, "Save table");
  byId("sections").replaceChildren(html("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": "Scales" }, table), html("div", { class: "row" }, save));
  progressed = () => {};
  while (nextPage) await listPage(nextPage);
  for (const path of [...known.keys()]) {
    let result;
    do {
      while (running.size) await pause(100); // a person's own call comes first
      if (!table.isConnected) return; // a photograph, or another table, has replaced it
      say(`Measuring ${nameOf(path)}: ${rows.length + 1} of ${known.size}.`);
      result = await estimated(path, region);
    } while (!result);
    const record = result.isError ? { status: "failed", error: textOf(result) } : recordOf(result);
    rows.push({ file: path, ...record });
    body.append(row(path, record));
  }
  if (!table.isConnected) return;
  byId("panel").setAttribute("aria-busy", "false");
  say(`${counted(rows.length, "photograph")}: ${rows.filter(({ status }) => status === "ok").length} with a usable scale.`);
}

function row(path, record) {
  const known = typeof record.gsd_m_per_px === "number";
  const [low, high] = [record.gsd_ci95_low_m_per_px, record.gsd_ci95_high_m_per_px];
  return html(
    "tr", {},
    html("th", { scope: "row" }, html("button", { type: "button", title: path, on: { click: () => choose(path) } }, nameOf(path))),
    html("td", {}, known ? number(record.gsd_m_per_px) : ""),
    html("td", {}, known && typeof low === "number" ? `${number(low)} to ${number(high)}` : ""),
    html("td", {}, typeof record.confidence === "number" ? record.confidence.toFixed(2) : ""),
    html("td", {}, record.error ?? STATUS[record.status].words),
  );
}

// A cell that a spreadsheet would run begins with an apostrophe.
function csv(rows) {
  const cell = (value) => {
    const text = typeof value === "string" && /^[=+\-@\t\r]/.test(value) ? `'${value}` : String(value ?? "");
    return /[",\n\r]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
  };
  const names = ["file", ...FIELDS, "error"];
  return [names, ...rows.map((each) => names.map((name) => each[name]))].map((cells) => `${cells.map(cell).join(",")}\n`).join("");
}

byId("all").addEventListener("click", measureAll);

// ---- Start ----

for (const [name, over] of [["dragenter", true], ["dragover", true], ["dragleave", false], ["drop", false]]) {
  window.addEventListener(name, (event) => {
    event.preventDefault();
    document.body.classList.toggle("dropping", over && event.dataTransfer.types.includes("Files"));
    if (name === "drop") take(event.dataTransfer.files);
  });
}
byId("files").addEventListener("change", (event) => take(event.target.files));
byId("open").addEventListener("click", () => byId("files").click());
byId("region").addEventListener("change", () => chosen && choose(chosen));
say("Drop aerial photographs here, or choose one from the list.");
byId("panel").setAttribute("aria-busy", "false");
listPage(1).then(() => {
  const wanted = decodeURIComponent(location.hash.slice(1)); // the photograph of the command line
  const first = known.has(wanted) ? wanted : known.keys().next().value;
  if (first && !chosen) choose(first);
}, (error) => fail(error.message));
