"""The certificate that is handed to a customer: what was found, on what evidence, and what went in."""
