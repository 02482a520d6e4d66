"""Training of the head that tells drawn things, such as letters and icons, from cars."""
