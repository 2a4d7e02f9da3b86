"""A registry of one small figure, for commands to import."""

from experiments.studies import figures_of_paper
from tests.experiments.studies.by_hand import SMALL

figures_of_paper.figures = lambda: {"small": SMALL}
