"""Off-board side: learns from recorded drives what each vehicle's high-voltage current sensors do wrong."""
