//! Numbers as people type and read them.

use serde::Serializer;
use std::fmt::{Display, LowerExp};

/// The largest whole number that TOML, and with it `config.toml`, can hold.
pub const WHOLE_MAX: u64 = i64::MAX as u64;

/// Why a text is no count.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum CountError {
    /// Not a number.
    #[error("write a whole number, such as 1000000, 1_000_000, 1e6, 100k or 2M")]
    NoNumber,
    /// Below zero.
    #[error("write a whole number of at least 0")]
    Negative,
    /// A number with a fraction, or written like one.
    #[error("write a whole number{}", .0.as_ref().map_or(String::new(), |whole| format!(": {whole}")))]
    Fraction(Option<String>),
    /// Beyond [`WHOLE_MAX`].
    #[error("it is out of range 0..={WHOLE_MAX}")]
    TooLarge,
}

/// A count as people write it: `1000000`, `1_000_000`, `1e6`, `100k`, `1.5M`. Exact, whatever its size.
///
/// # Errors
/// When it is no whole number, or one beyond [`WHOLE_MAX`].
pub fn count(text: &str) -> Result<u64, CountError> {
    let text = text.trim();
    let (unsigned, negative) = text.strip_prefix('-').map_or((text, false), |rest| (rest, true));
    let unsigned = if negative { unsigned } else { unsigned.strip_prefix('+').unwrap_or(unsigned) };
    let (mantissa, exponent, scaled) = split_scale(unsigned).ok_or(CountError::NoNumber)?;
    let (whole, fraction) = mantissa.split_once('.').unwrap_or((mantissa, ""));
    if !is_digits(whole) || (mantissa.contains('.') && !is_digits(fraction)) {
        return Err(CountError::NoNumber);
    }
    if negative {
        return Err(CountError::Negative);
    }
    let fraction = fraction.trim_end_matches(['0', '_']).replace('_', "");
    if !scaled && mantissa.contains('.') {
        return Err(CountError::Fraction(fraction.is_empty().then(|| whole.to_owned())));
    }
    let digits = whole.replace('_', "") + &fraction;
    let digits = digits.trim_start_matches('0');
    let zeros = exponent - fraction.len() as i32;
    if digits.is_empty() {
        return Ok(0);
    }
    if zeros < 0 {
        return Err(CountError::Fraction(None));
    }
    // No number of more digits than the largest fits; this keeps `1e999999` from being written out.
    if digits.len() + zeros as usize > 19 {
        return Err(CountError::TooLarge);
    }
    let number: u64 =
        format!("{digits}{}", "0".repeat(zeros as usize)).parse().map_err(|_| CountError::TooLarge)?;
    if number > WHOLE_MAX { Err(CountError::TooLarge) } else { Ok(number) }
}

/// Mantissa and power of ten, and whether one was written.
fn split_scale(text: &str) -> Option<(&str, i32, bool)> {
    for (suffixes, exponent) in [(['k', 'K'], 3), (['M', 'M'], 6), (['G', 'G'], 9)] {
        if let Some(mantissa) = text.strip_suffix(suffixes) {
            return Some((mantissa, exponent, true));
        }
    }
    match text.split_once(['e', 'E']) {
        Some((mantissa, exponent)) => {
            // An exponent of more digits is beyond every number here, either way.
            let exponent: i32 = exponent.parse().ok().filter(|exponent: &i32| exponent.abs() < 1_000_000)?;
            Some((mantissa, exponent, true))
        }
        None => Some((text, 0, false)),
    }
}

/// Digits, with `_` between them at most.
fn is_digits(text: &str) -> bool {
    let ends = |c: Option<char>| c.is_some_and(|c| c.is_ascii_digit());
    ends(text.chars().next())
        && ends(text.chars().last())
        && !text.contains("__")
        && text.chars().all(|c| c.is_ascii_digit() || c == '_')
}

/// A number in as few digits as lead back to it.
pub fn shown(number: impl Display + LowerExp + Into<f64> + Copy) -> String {
    let size = number.into().abs();
    if size == 0.0 || !size.is_finite() || (1e-4..1e9).contains(&size) {
        number.to_string()
    } else {
        format!("{number:e}")
    }
}

/// Writes a number of single precision as the shortest decimal that leads back to it: 0.001, not
/// 0.0010000000474974513.
///
/// # Errors
/// When the serialiser refuses.
pub fn shortest<S: Serializer>(number: &f32, serializer: S) -> Result<S::Ok, S::Error> {
    // What Rust writes of a float, it reads.
    let number = number.to_string().parse().unwrap_or_else(|_| f64::from(*number));
    serializer.serialize_f64(number)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn counts_are_read_as_people_write_them() {
        for (text, number) in [
            ("0", 0),
            ("007", 7),
            ("+5", 5),
            (" 1000000 ", 1_000_000),
            ("1_000_000", 1_000_000),
            ("1e6", 1_000_000),
            ("1E6", 1_000_000),
            ("1e+6", 1_000_000),
            ("12.5e1", 125),
            ("100k", 100_000),
            ("100K", 100_000),
            ("2M", 2_000_000),
            ("1.5M", 1_500_000),
            ("0.001k", 1),
            ("3G", 3_000_000_000),
            ("0e999", 0),
            ("9223372036854775807", WHOLE_MAX),
        ] {
            assert_eq!(count(text), Ok(number), "{text}");
        }
    }

    #[test]
    fn what_is_no_count_is_said() {
        for text in ["", "high", "k", "1e", "e6", "1__0", "_1", "1_", "1.", ".5", "1m", "0x10", "1e6.0", "١"]
        {
            assert_eq!(count(text), Err(CountError::NoNumber), "{text}");
        }
        assert_eq!(count("-1"), Err(CountError::Negative));
        assert_eq!(count("32.0"), Err(CountError::Fraction(Some("32".into()))));
        assert_eq!(count("32.5"), Err(CountError::Fraction(None)));
        assert_eq!(count("1.5e0"), Err(CountError::Fraction(None)));
        assert_eq!(count("1e-1"), Err(CountError::Fraction(None)));
        for text in ["9223372036854775808", "18446744073709551615", "1e30", "1e999999", "99999999999G"] {
            assert_eq!(count(text), Err(CountError::TooLarge), "{text}");
        }
    }

    #[test]
    fn numbers_are_shown_so_that_they_lead_back() {
        let text = [1e-12_f32, 1e30, 0.0005, 0.001, 1.0, 0.0, f32::INFINITY].map(shown);
        assert_eq!(text, ["1e-12", "1e30", "0.0005", "0.001", "1", "0", "inf"]);
        let text = [1e-300_f64, 1e9, 123.456, -1e-12].map(shown);
        assert_eq!(text, ["1e-300", "1e9", "123.456", "-1e-12"]);
        // A sample of all there are, neighbours in bits far apart in value.
        for bits in (0..0x7f80_0000_u32).step_by(65_521) {
            let number = f32::from_bits(bits);
            assert_eq!(shown(number).parse::<f32>().unwrap().to_bits(), bits);
            let double: f64 = number.to_string().parse().unwrap();
            assert_eq!((double as f32).to_bits(), bits, "through TOML's double precision");
        }
    }
}
