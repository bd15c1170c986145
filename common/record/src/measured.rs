//! What an update reported, by the names that its method gives.

use rit_algo::learner::Measure;
use serde::{
    Deserialize, Deserializer, Serialize, Serializer,
    de::{MapAccess, Visitor},
    ser::SerializeMap as _,
};
use serde_json::{Map, Value};
use std::fmt;

/// Names and values, in the method's order. In a file they are keys of the object they stand in.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Measured {
    /// The numbers; NaN where the file says `null`.
    pub values: Vec<(String, f64)>,
    /// What stands beside them and is no number: kept as it is.
    pub other: Map<String, Value>,
}

impl Measured {
    /// Of these measures, the values that an update returned.
    pub fn new(measures: &[Measure], values: &[f64]) -> Self {
        let named = measures.iter().zip(values);
        named.map(|(measure, &value)| (measure.name.to_owned(), value)).collect()
    }
}

impl FromIterator<(String, f64)> for Measured {
    fn from_iter<T: IntoIterator<Item = (String, f64)>>(named: T) -> Self {
        Self { values: named.into_iter().collect(), other: Map::new() }
    }
}

impl Serialize for Measured {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut map = serializer.serialize_map(Some(self.values.len() + self.other.len()))?;
        for (name, value) in &self.values {
            map.serialize_entry(name, value)?;
        }
        for (name, value) in &self.other {
            map.serialize_entry(name, value)?;
        }
        map.end()
    }
}

impl<'de> Deserialize<'de> for Measured {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Names;
        impl<'de> Visitor<'de> for Names {
            type Value = Measured;

            fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str("numbers by name")
            }

            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Measured, A::Error> {
                let mut measured = Measured::default();
                while let Some((name, value)) = map.next_entry::<String, Value>()? {
                    match value {
                        Value::Null => measured.values.push((name, f64::NAN)),
                        Value::Number(number) => {
                            measured.values.push((name, number.as_f64().unwrap_or(f64::NAN)));
                        }
                        value => {
                            measured.other.insert(name, value);
                        }
                    }
                }
                Ok(measured)
            }
        }
        deserializer.deserialize_map(Names)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// An object that holds more than measures, as a line of metrics does.
    #[derive(Debug, PartialEq, Serialize, Deserialize)]
    struct Line {
        env_steps: u64,
        #[serde(flatten)]
        measured: Measured,
    }

    #[test]
    fn names_are_keys_and_keep_their_order() {
        let measures = [("td_loss", "TD loss"), ("grad_norm", "Gradient norm")]
            .map(|(name, help)| Measure { name, help });
        let line = Line { env_steps: 7, measured: Measured::new(&measures, &[0.5, 1e-9]) };
        let text = serde_json::to_string(&line).unwrap();
        assert_eq!(text, r#"{"env_steps":7,"td_loss":0.5,"grad_norm":1e-9}"#);
        assert_eq!(serde_json::from_str::<Line>(&text).unwrap(), line);
    }

    #[test]
    fn what_is_no_number_is_kept_and_null_is_nan() {
        let text = r#"{"env_steps":7,"td_loss":null,"note":"by hand","list":[1]}"#;
        let line: Line = serde_json::from_str(text).unwrap();
        assert!(line.measured.values[0].1.is_nan());
        assert_eq!(line.measured.other.len(), 2);
        let again = serde_json::to_string(&line).unwrap();
        assert_eq!(again, r#"{"env_steps":7,"td_loss":null,"list":[1],"note":"by hand"}"#);
    }
}
