"""Sources of images: paths, arrays, Pillow images and rasterio datasets."""
