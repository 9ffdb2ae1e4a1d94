"""The report: a web page that opens offline, pictures for print, and `diagnosis.json`."""

from ._numbers import plus_minus as plus_minus
from ._write import write_report as write_report
