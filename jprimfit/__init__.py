"""jprimfit: from a scanned point cloud of a mechanical part to planes, spheres, cylinders and cones."""

__version__ = "0.1.0"
