"""From a cloud to tomatoes, stems and clutter."""
