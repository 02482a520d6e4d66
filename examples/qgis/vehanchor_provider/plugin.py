"""The plugin and its Processing provider."""

from qgis.core import QgsApplication, QgsProcessingProvider

from .algorithms import EstimateScale, LocalMetres


class VehAnchorProvider(QgsProcessingProvider):
    """The algorithms, as the toolbox lists them."""

    def id(self):
        """The first half of each algorithm's name."""
        return "vehanchor"

    def name(self):
        """What people read."""
        return "VehAnchor"

    def loadAlgorithms(self):  # noqa: N802 - QGIS calls it so
        """Add them."""
        self.addAlgorithm(EstimateScale())
        self.addAlgorithm(LocalMetres())


class VehAnchorPlugin:
    """What QGIS loads: with a window or, for ``qgis_process``, without."""

    def __init__(self):
        self.provider = None

    def initProcessing(self):  # noqa: N802 - QGIS calls it so
        """Register the provider."""
        self.provider = VehAnchorProvider()
        QgsApplication.processingRegistry().addProvider(self.provider)

    def initGui(self):  # noqa: N802 - QGIS calls it so
        """Begin: there is nothing but the provider."""
        self.initProcessing()

    def unload(self):
        """End."""
        QgsApplication.processingRegistry().removeProvider(self.provider)
