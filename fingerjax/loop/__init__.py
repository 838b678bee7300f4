"""From a residual to the effect that a model lacks: noise, fit, mesh, score, refit, verdict.

Start at `diagnosis.diagnose`; what a model must offer is said in `subject`, what comes back in `record`.
"""
