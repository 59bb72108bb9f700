"""The exception for bad input, as opposed to a defect of the program."""


class InputError(ValueError):
    """Bad input or arguments.

    The message names the file or argument, the line or column, what is wrong and how to mend it. The
    command line prints it on standard error and exits with status 2; a Python caller catches it as a
    `ValueError`.
    """

    def __init__(self, where: str, what: str, mend: str) -> None:
        self.where, self.what, self.mend = where, what, mend
        super().__init__(f"{where}: {what}. {mend}")
