"""The command line: one thin module a command; `app` turns errors into exit codes, `console` alone prints."""
