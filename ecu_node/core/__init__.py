"""Pure core of the node, without input or output: it takes frames and times, and returns frames and states."""
