"""Multi-agent reinforcement learning over many tasks: trained policies, and environments of your own.

The program itself, ``rit``, comes with this package: ``rit --help``.
"""

from rit._rit import ActError, RitError, WeightsError
from rit.policy import Policy

__all__ = ["ActError", "Policy", "RitError", "WeightsError"]
