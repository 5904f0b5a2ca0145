//! The dates and times of a grant's validity.

use std::time::{SystemTime, UNIX_EPOCH};

use toml::value::{Datetime, Offset};

/// Parses a date and time of XML Schema to seconds since 1970. Without a time zone it is UTC (DDS Security 1.1,
/// 9.4.1.3.2.2).
pub(super) fn seconds(text: &str) -> Option<i64> {
    let Datetime { date: Some(date), time: Some(time), offset } = text.parse().ok()? else {
        return None;
    };
    let minutes = match offset {
        None | Some(Offset::Z) => 0,
        Some(Offset::Custom { minutes }) => i64::from(minutes),
    };
    let days = days(i64::from(date.year), i64::from(date.month), i64::from(date.day));
    let of_day = i64::from(time.hour) * 3600 + i64::from(time.minute) * 60;
    let second = time.second.map_or(0, i64::from);
    Some(days * 86_400 + of_day + second - minutes * 60)
}

/// Returns the days from 1970-01-01 to a day of the Gregorian calendar.
const fn days(year: i64, month: i64, day: i64) -> i64 {
    // The year begins with March here, so that a leap day is its last day.
    let (year, month) = if month > 2 { (year, month - 3) } else { (year - 1, month + 9) };
    let leap_days = year.div_euclid(4) - year.div_euclid(100) + year.div_euclid(400);
    let of_year = (153 * month + 2) / 5 + day - 1;
    year * 365 + leap_days + of_year - 719_468
}

/// Converts a time to seconds since 1970.
pub(super) fn of_clock(now: SystemTime) -> i64 {
    let whole = |seconds: u64| i64::try_from(seconds).unwrap_or(i64::MAX);
    match now.duration_since(UNIX_EPOCH) {
        Ok(since) => whole(since.as_secs()),
        Err(before) => -whole(before.duration().as_secs()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn dates_are_seconds_of_utc() {
        for (text, expected) in [
            ("1970-01-01T00:00:00", 0),
            ("1970-01-01T00:00:00Z", 0),
            ("1970-01-01T02:00:00+02:00", 0),
            ("1969-12-31T23:59:59", -1),
            ("2000-02-29T12:00:00", 951_825_600),
            ("2026-11-28T13:45:23Z", 1_795_873_523),
            ("2100-03-01T00:00:00", 4_107_542_400),
            ("2013-10-26T22:45:30.5-03:00", 1_382_838_330),
            ("9999-12-31T23:59:59", 253_402_300_799),
        ] {
            assert_eq!(seconds(text), Some(expected), "{text}");
        }
        for wrong in
            ["", "2026-01-01", "12:00:00", "2026-02-30T00:00:00", "2026-13-01T00:00:00", "soon"]
        {
            assert_eq!(seconds(wrong), None, "{wrong}");
        }
    }

    #[test]
    fn each_day_is_one_behind_the_day_before() {
        let lengths =
            |leap: bool| [31, 28 + i64::from(leap), 31, 30, 31, 30, 31, 31, 30, 31, 30, 31];
        let mut expected = days(1600, 1, 1);
        for year in 1600..2405 {
            let leap = year % 4 == 0 && (year % 100 != 0 || year % 400 == 0);
            for (month, length) in (1..).zip(lengths(leap)) {
                for day in 1..=length {
                    assert_eq!(days(year, month, day), expected, "{year}-{month}-{day}");
                    expected += 1;
                }
            }
        }
    }
}
