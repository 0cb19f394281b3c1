"""Names of profiles, for people."""

from xethru_protocol.codes import ProfileId


def profile_name(profile_id: int) -> str:
    """Short name of a profile, or its number.

    >>> profile_name(0x014D4AB8), profile_name(5)
    ('PRESENCE_2', '0x00000005')
    """
    for known in ProfileId:
        if known == profile_id:
            return known.name.removeprefix("XTS_ID_APP_")
    return f"0x{profile_id:08X}"
