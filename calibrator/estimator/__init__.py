"""Estimate from the summaries of a fleet what each of its sensors does wrong.

Read in this order, with docs/method.md beside it:

    evidence, readings              regressions on the junction law and on the fleet; what is known of single sensors
    prior, posterior                which faults explain the rows of a vehicle, and how probable each is
    learning                        what the fleet says of its faults, and of vehicles without any
    decision, checks                estimate, confidence, harm; whether the best explanation fits
    fleet_estimate                  all of this for a fleet (learn_fleet), then for each vehicle (estimate_vehicles)
    vehicle_report                  what was found for a vehicle, in words
    vehicle_parameters, results     the parameters of a vehicle (parameters_of), and the folder that a run writes
    settings, run, fleet_task       the command: a sample of the fleet is learnt from, then it goes bucket by bucket
    junction, junction_run          one junction without a fleet: an estimator of its own, from sensors that are known
    fleet, frames                   the Python interface: data frames in, parameters out

``published_fleet`` runs the published method in the same way; ``fleet_identification`` finds a filter bank for fleets
whose currents do not follow from the inputs at the same instant.
"""
