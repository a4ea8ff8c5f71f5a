"""Labels of Gaussians that no view explains, by their neighbours."""
