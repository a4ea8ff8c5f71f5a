"""Reports: self-contained HTML pages, charts and sheets of images."""
