"""What is installed, whether it works, and whether it will work on somebody's images."""
