"""A layout proposed from a DBC, and from a log where there is one."""
