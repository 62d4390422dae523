"""Estimate from the summaries of a fleet what each of its sensors does wrong.

Read in this order, with docs/method.md beside it:

    evidence, readings              regressions on the junction law and on the fleet; what is known of single sensors
    prior, posterior                which faults explain the rows of a vehicle, and how probable each is
    learning                        what the fleet says of its faults, and of vehicles without any
    decision, checks                estimate, confidence, harm; whether the best explanation fits
    fleet_estimate, vehicle_report  all of this for a fleet, then for each vehicle; the report on a vehicle
    junction, junction_run          one junction without a fleet: an estimator of its own, from sensors that are known
    settings, fleet_task, run       the command: bucket by bucket, over processes
    results                         the folder that it writes
    fleet, frames                   the Python interface: data frames in, parameters out

``published_fleet`` runs the published method in the same way; ``fleet_identification`` finds a filter bank for fleets
whose currents do not follow from the inputs at the same instant.
"""
