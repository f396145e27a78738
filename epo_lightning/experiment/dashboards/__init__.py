"""Dashboards: places outside of the run folder where a run's log can be watched; none of them may disturb a run."""
