// ---- Inside a host of MCP Apps ----

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
