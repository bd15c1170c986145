//! Numbers in JSON, which has no NaN and no infinity: they are written as `null`.

use serde::{Deserialize as _, Deserializer};

/// Reads `null` as NaN.
pub(crate) fn or_nan<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f64, D::Error> {
    Ok(Option::<f64>::deserialize(deserializer)?.unwrap_or(f64::NAN))
}
