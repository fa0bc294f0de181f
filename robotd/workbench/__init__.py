"""The detector workbench (thesis section 6.3.2): tagged footage, any detector with any settings, judged and shown."""
