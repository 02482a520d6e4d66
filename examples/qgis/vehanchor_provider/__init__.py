"""A QGIS plugin: VehAnchor's command as Processing algorithms."""


def classFactory(iface):  # noqa: ARG001, N802 - QGIS calls it so
    """Make the plugin."""
    from .plugin import VehAnchorPlugin

    return VehAnchorPlugin()
