"""Plants that give way: topology of a row, compliant bodies in slots, and fruit that comes off."""
