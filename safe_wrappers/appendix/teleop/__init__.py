"""Wave variables, and the passivity controller of one port."""
