//! What people are told of a failed call, without the words of the libraries in between.

use std::error::Error as _;
use tonic::{Code, Status};

/// Why a call failed, in words. What the other side says of it is kept; what the libraries say of a connection that
/// broke means nothing to its reader.
pub fn status_words(status: &Status) -> String {
    let broke = || "the connection broke".to_owned();
    match status.code() {
        Code::DeadlineExceeded => "no answer came in time".to_owned(),
        Code::Cancelled if status.source().is_some() => "no answer came in time".to_owned(),
        // Only a status made here has a cause below it.
        _ if status.source().is_some() || status.message().is_empty() => broke(),
        // A stream that the other side reset comes as a status of its own.
        _ if is_of_a_library(status.message()) => broke(),
        _ => status.message().to_owned(),
    }
}

/// Whether these words are those of HTTP/2 and what lies below it.
pub(super) fn is_of_a_library(words: &str) -> bool {
    ["h2 protocol error", "http2 error", "transport error", "error reading a body", "stream error received"]
        .iter()
        .any(|part| words.contains(part))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_the_other_side_says_is_kept_and_what_libraries_say_is_not() {
        let cause = std::io::Error::other("h2 protocol error: error reading a body from connection");
        assert_eq!(status_words(&Status::from_error(Box::new(cause))), "the connection broke");
        assert_eq!(status_words(&Status::unknown("h2 protocol error: http2 error")), "the connection broke");
        assert_eq!(status_words(&Status::deadline_exceeded("Timeout expired")), "no answer came in time");
        assert_eq!(status_words(&Status::unavailable("the run is over")), "the run is over");
    }
}
