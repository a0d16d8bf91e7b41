"""Reporting: records as tables, pictures, pages and videos. It computes nothing.

- `style`: the palette in light and dark, markers, dashes, and matplotlib's settings.
- `figures`: a matplotlib figure as SVG for a page, as an SVG file and as PNG.
- `charts`, `diagnosis_charts`, `network_maps`, `phase_diagrams`: records as figures.
- `page`, ``templates/``: pages of HTML; `training_page` and `diagnosis_page` fill them in.
- `run_records`, `run_groups`, `places`: trainings, read from their folders and put into groups, and
  the places of their agents.
- `street_found`, `intersection_findings`: what a training found of the street and of each light.
- `tables`, `gap_tables`, `comparison_tables`, `diagnosis_tables`, `headroom_table`,
  `service_tables`, `standings`, `learning_curves`: tables for the terminal, as Markdown and as CSV;
  `terminal` is their common form.
- `light_names`: names of a traffic light in a table.
- `formats`, `diagnosis_words`: numbers and verdicts as texts.
- `video`: episodes as videos.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
