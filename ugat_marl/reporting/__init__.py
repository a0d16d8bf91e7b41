"""Reporting: records as tables, pictures, pages and videos. It computes nothing.

- `style`: the palette in light and dark, markers, dashes, and matplotlib's settings.
- `figures`: a matplotlib figure as SVG for a page, as an SVG file and as PNG.
- `charts`, `diagnosis_charts`, `network_maps`, `phase_diagrams`: records as figures.
- `page`, ``templates/``: pages of HTML; `training_page` and `diagnosis_page` fill them in.
- `run_records`, `run_groups`: trainings, read from their folders and put into groups.
- `tables`, `gap_tables`, `comparison_tables`, `diagnosis_tables`, `headroom_table`,
  `learning_curves`: tables for the terminal, as Markdown and as CSV.
- `formats`, `diagnosis_words`: numbers and verdicts as texts.
- `video`: episodes as videos.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
