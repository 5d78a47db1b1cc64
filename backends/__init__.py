"""Real devices: lines own ports, protocols know languages, devices map them to the interfaces."""
