"""From a study to numbers: what every instrument would have read, given the parameters.

`wiring` says which parameter enters which layer of which subject; `rigs` turn rows of a measurement into indentations and readings;
`model` computes them all from one condensation of the body for each material.
"""

from .model import Assembled, Model, Prediction, Residuals, assemble, meshed

__all__ = ["Assembled", "Model", "Prediction", "Residuals", "assemble", "meshed"]
