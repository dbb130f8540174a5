"""Shapes of objects, links and obstacles; convex hulls, polygons and meshes."""
