"""Labels put back on splats that an editor changed."""
