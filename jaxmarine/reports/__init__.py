"""The report: a web page that opens offline, pictures for print, and `diagnosis.json` (extra `report`)."""

from .._extras import of_extra

with of_extra("report", "A report"):
    from ._causes import title as title
    from ._page import templates as templates
    from ._svg import Plot as Plot
    from ._write import write_report as write_report
