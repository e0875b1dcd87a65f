"""The technician's page: status, alarms, live pressure and trends, in a process of its own."""
