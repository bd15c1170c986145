//! What single values on the command line may be, with the words for those that they may not.

use rit_config::{WHOLE_MAX, WebListen, count};
use rit_learner::checkpoint::Which;
use std::net::IpAddr;

pub(super) fn web_listen(text: &str) -> Result<WebListen, String> {
    WebListen::try_from(text.to_owned())
}

/// Two names with a comma between them.
pub(super) fn pair(text: &str) -> Result<(String, String), String> {
    match text.split_once(',').map(|(x, y)| (x.trim(), y.trim())) {
        Some((x, y)) if !x.is_empty() && !y.is_empty() => Ok((x.to_owned(), y.to_owned())),
        _ => Err("write two methods, such as rit,qmix-attn".to_owned()),
    }
}

pub(super) fn positive(text: &str) -> Result<f64, String> {
    let seconds = finite(text)?;
    if (0.0..=3600.0).contains(&seconds) && seconds > 0.0 {
        Ok(seconds)
    } else {
        Err("it must lie above 0 and up to 3600".into())
    }
}

pub(super) fn finite(text: &str) -> Result<f64, String> {
    let number = text.trim().parse().ok().filter(|number: &f64| number.is_finite());
    number.ok_or_else(|| "write a number, such as -12.5".to_owned())
}

/// Reads a count in this range.
pub(super) fn within<T: TryFrom<u64>>(min: u64, max: u64) -> impl Fn(&str) -> Result<T, String> + Clone {
    move |text| {
        let out_of_range = || format!("it is out of range {min}..={}", max.min(WHOLE_MAX));
        let number = match count(text) {
            Err(rit_config::CountError::TooLarge) => return Err(out_of_range()),
            number => number.map_err(|error| error.to_string())?,
        };
        if !(min..=max).contains(&number) {
            return Err(out_of_range());
        }
        T::try_from(number).map_err(|_| out_of_range())
    }
}

/// Which of a run's weights.
pub(super) fn which(text: &str) -> Result<Which, String> {
    match text {
        "latest" => Ok(Which::Latest),
        "best" => Ok(Which::Best),
        _ => text
            .strip_prefix("step-")
            .and_then(|step| count(step).ok())
            .map(Which::Step)
            .ok_or_else(|| "write latest, best or step-N, such as step-100000".to_owned()),
    }
}

/// A name as labels of Kubernetes may be.
pub(super) fn label(text: &str) -> Result<String, String> {
    let is_plain = |c: char| c.is_ascii_lowercase() || c.is_ascii_digit() || c == '-' || c == '.';
    let ends = [text.chars().next(), text.chars().last()];
    if text.len() <= 63
        && text.chars().all(is_plain)
        && ends.iter().flatten().all(char::is_ascii_alphanumeric)
        && !text.is_empty()
    {
        Ok(text.to_owned())
    } else {
        Err("write a queue's name, of small letters, digits, '-' and '.'".to_owned())
    }
}

/// A name or address that a certificate can be for: what a DNS name may be, or an IP address.
pub(super) fn host(text: &str) -> Result<String, String> {
    let is_label = |label: &str| {
        let inner = |c: char| c.is_ascii_alphanumeric() || c == '-' || c == '_';
        (1..=63).contains(&label.len())
            && label.chars().all(inner)
            && !label.starts_with('-')
            && !label.ends_with('-')
    };
    let name = text.strip_prefix("*.").unwrap_or(text);
    if text.parse::<IpAddr>().is_ok() || (name.len() <= 253 && name.split('.').all(is_label)) {
        Ok(text.to_owned())
    } else {
        Err("write a host's name or IP address, such as learner.example.org or 10.0.0.1".to_owned())
    }
}
