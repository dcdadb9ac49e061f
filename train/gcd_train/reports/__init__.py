"""Reports: what runs of evaluation found, as the paper's tables, plots, galleries and failure cases.

Only records and kept frames are read; nothing is measured again.
"""

from gcd_train.reports.comparison import Difference, differences
from gcd_train.reports.curves import Curve, Plot, Point, all_plots
from gcd_train.reports.failures import WorstClip, worst_clips
from gcd_train.reports.figure_tables import Measured, all_figures, main_tables
from gcd_train.reports.intervals import Drawn, Interval, difference, drawn
from gcd_train.reports.material import EvaluatedSet, Method, Run, gather
from gcd_train.reports.pages import Choices, leads, make_report
from gcd_train.reports.paper import PAPER_TABLES, PaperTable, row_label, tables_for
from gcd_train.reports.table import Cell, Row, Table

__all__ = [
    "PAPER_TABLES",
    "Cell",
    "Choices",
    "Curve",
    "Difference",
    "Drawn",
    "EvaluatedSet",
    "Interval",
    "Measured",
    "Method",
    "PaperTable",
    "Plot",
    "Point",
    "Row",
    "Run",
    "Table",
    "WorstClip",
    "all_figures",
    "all_plots",
    "difference",
    "differences",
    "drawn",
    "gather",
    "leads",
    "main_tables",
    "make_report",
    "row_label",
    "tables_for",
    "worst_clips",
]
