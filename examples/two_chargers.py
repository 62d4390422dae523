"""
One car at two chargers
=======================

A BMW i3 charges at two stations. Battery and charger measure the same current, and they disagree: at one station the
battery reads less, at the other more. Real recordings, see the head of ``bmw_i3_two_chargers.csv`` for their source.
"""

import pandas as pd

from calibrator import Junction, JunctionCalibrator

table = pd.read_csv("bmw_i3_two_chargers.csv", comment="#")
sessions = {name: rows.set_index("time_s")[["battery", "charger"]] for name, rows in table.groupby("station")}
sums = pd.DataFrame({name: rows.sum(axis=1) for name, rows in sessions.items()})
axes = sums.plot(ylabel="charger less battery [A]", ylim=(-4.0, 4.0), figsize=(8.0, 4.0))

# %%
# One car, so one battery sensor; ``meter`` says that the charger's is another one at each station. After the plug the
# car draws 0.7 to 0.9 A itself, which no sensor measures.
junction = Junction(branches=["battery", "charger"], full_scale_a=200.0)
calibrator = JunctionCalibrator(trusted=["battery"], meter="charger", load=(0.8, 0.1)).fit(sessions, junction)
found = calibrator.parameters_.query("branch == 'charger'").set_index("vehicle")
found[["gain_error", "gain_error_sd", "offset_a", "offset_sd_a", "corrected"]]

# %%
# So one station reads 1.2 % more than the battery, the other 1.4 % less: they differ by 2.6 %. Which of the three is
# right, nothing in these recordings tells: trusting a station instead gives the battery's gain error.
for notice in calibrator.notices_:
    print(notice)
