"""The certificate that is handed to a customer: a page and a PDF."""
