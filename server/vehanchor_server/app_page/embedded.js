// ---- Start inside an MCP App host ----

const factsStated = measureWithFacts;

function shown(scale) {
  byId("facts").hidden = !(scale && canCallTools && call.arguments);
  if (call.arguments) fillInFacts(call.arguments);
  offerFacts();
}

if (window.parent === window) {
  say("This page shows VehAnchor results inside an MCP App host. It shows nothing on its own.");
} else {
  request("ui/initialize", {
    appInfo: { name: "VehAnchor panel", version: "1.0.0" },
    appCapabilities: { availableDisplayModes: ["inline", "fullscreen"] },
    protocolVersion: PROTOCOL_VERSION,
  }).then((host) => {
    canCallTools = Boolean(host.hostCapabilities?.serverTools);
    adopt(host.hostContext ?? {});
    notify("ui/notifications/initialized");
    new ResizeObserver(() => {
      const height = Math.ceil(document.documentElement.getBoundingClientRect().height);
      notify("ui/notifications/size-changed", { width: window.innerWidth, height });
    }).observe(document.documentElement);
  }, (error) => fail(`The host refused this page: ${error.message}`));
}
