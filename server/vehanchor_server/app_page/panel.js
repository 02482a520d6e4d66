// ---- The whole ----

const isArea = (record) => "mask_area_px" in record;
const textOf = (result) => (result.content ?? []).filter((part) => part.type === "text").map((part) => part.text).join(" ");

function show(result) {
  const record = result._meta?.[PANEL_KEY]?.record ?? result.structuredContent?.measurements?.[0] ?? result.structuredContent;
  if (result.isError) return fail(textOf(result));
  byId("panel").setAttribute("aria-busy", "false");
  say(textOf(result));
  if (!record) return byId("sections").replaceChildren();
  const scale = isArea(record) ? record.scale : record;
  const histogram = result._meta?.[PANEL_KEY]?.histogram;
  byId("subject").textContent = isArea(record) ? "area of an object" : "metric scale";
  flag(record.status);
  const plan = isArea(record) ? planSection(record) : undefined;
  const lengths = scale && histogram ? histogramSection(scale, histogram) : undefined;
  const beside = plan && pictureOf(result); // the plan then stands beside the picture, and the lengths below that
  const left = [beside ? undefined : plan, picture(record, result), beside ? lengths : undefined].filter(Boolean);
  const right = [beside ? plan : undefined, scale ? confidence(scale) : undefined, recordSection(record)];
  const sections = [
    readings(record),
    warningSection(record),
    scale ? rulersSection(scale) : undefined,
    html(
      "div", { class: "columns" },
      left.length ? html("div", { class: "column seen" }, ...left) : undefined,
      html("div", { class: "column" }, ...right),
    ),
    beside ? undefined : lengths,
  ];
  byId("sections").replaceChildren(...sections.filter(Boolean));
}

function reportSize() {
  const height = Math.ceil(document.documentElement.getBoundingClientRect().height);
  notify("ui/notifications/size-changed", { width: window.innerWidth, height });
}

if (window.parent === window) {
  say("This page shows results of VehAnchor inside a host of MCP Apps; opened by itself it has nothing to show.");
} else {
  request("ui/initialize", {
    appInfo: { name: "VehAnchor panel", version: "1.0.0" },
    appCapabilities: { availableDisplayModes: ["inline", "fullscreen"] },
    protocolVersion: PROTOCOL_VERSION,
  }).then((host) => {
    canCallTools = Boolean(host.hostCapabilities?.serverTools);
    adopt(host.hostContext ?? {});
    notify("ui/notifications/initialized");
    new ResizeObserver(reportSize).observe(document.documentElement);
  }, (error) => fail(`The host refused this page: ${error.message}`));
}
