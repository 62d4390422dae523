"""The node around :mod:`ecu_node.core`: its buses, clocks, files and service manager."""
