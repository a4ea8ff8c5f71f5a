"""What tests of several folders share: a generated capture, evidence, a scorer."""
