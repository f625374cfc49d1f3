"""The history of a bridge over years: results, periods, alarms."""
