"""What the page of trainings adds to the style of all pages: the colours of its pictures."""

from __future__ import annotations

from ugat_marl.reporting.palette import DARK, LIGHT

_COLOURS = [name for name in LIGHT if name[0] in "cq" and name[1:].isdigit()]


def _properties(colours: dict[str, str]) -> str:
    return " ".join(f"--{name}: {colours[name]};" for name in _COLOURS)


RUN_STYLE = f"""
:root {{ {_properties(LIGHT)} }}
@media screen and (prefers-color-scheme: dark) {{
  :root {{ {_properties(DARK)} }}
}}
.maps figure {{ break-inside: avoid; }}
.maps svg {{ background: none; max-height: none; max-width: 36rem; }}
figure.missing {{ color: var(--soft); font-size: .9rem; }}
article {{ border-top: 3px solid var(--line); margin-top: 2.4rem; }}
article > h2 {{ border: 0; margin-top: .8rem; font-size: 1.3rem; }}
ul.plain {{ padding-left: 1.1rem; margin: .4rem 0; }}
.n {{ white-space: normal; }}
.many {{ font-size: .86rem; }}
.many th, .many td {{ padding-right: .5rem; }}
.many td:not(.n, [data-label=rank]) {{ min-width: 3.2rem; }}
th, .n {{ overflow-wrap: normal; }}
@media screen and (max-width: 56rem) {{
  .many {{ font-size: .72rem; }}
  .many th, .many .n {{ overflow-wrap: anywhere; }}
}}
@media screen and (max-width: 40rem) {{
  .stack thead {{ display: block; left: 0; width: 1px; }}
  .many {{ font-size: .9rem; }}
}}
@media print {{
  :root {{ {_properties(LIGHT)} }}
  .maps {{ grid-template-columns: 1fr 1fr; }}
  .many {{ font-size: .72rem; }}
}}
"""
