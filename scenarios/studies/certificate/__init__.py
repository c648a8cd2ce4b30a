"""The certificate that is handed to a customer: results, evidence, and input files."""
