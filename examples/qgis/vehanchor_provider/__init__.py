"""QGIS plugin: VehAnchor's command as Processing algorithms."""


def classFactory(iface):  # noqa: ARG001, N802 - QGIS's name
    """Create the plugin."""
    from .plugin import VehAnchorPlugin

    return VehAnchorPlugin()
