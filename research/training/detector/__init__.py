"""The bundled oriented-box vehicle detector: data, network, loss, training, export."""
