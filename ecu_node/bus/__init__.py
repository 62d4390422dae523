"""The node's buses, clocks, files and surroundings around :mod:`ecu_node.core`."""
