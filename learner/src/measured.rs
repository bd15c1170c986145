//! What an update reported, by the names that its method gives.

use rit_algo::learner::Measure;
use rit_proto::v1;
use serde::{
    Deserialize, Deserializer, Serialize, Serializer,
    de::{MapAccess, Visitor},
    ser::SerializeMap as _,
};
use std::fmt;

/// Names and values, in the method's order. In a file they are keys of the object they stand in.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Measured(pub Vec<(String, f64)>);

impl Measured {
    /// Of these measures, the values that an update returned.
    pub fn new(measures: &[Measure], values: &[f64]) -> Self {
        let named = measures.iter().zip(values);
        Self(named.map(|(measure, &value)| (measure.name.to_owned(), value)).collect())
    }

    /// As messages, with what each is according to `measures`.
    pub fn to_messages(&self, measures: &[Measure]) -> Vec<v1::Measure> {
        let help =
            |name: &str| measures.iter().find(|measure| measure.name == name).map(|measure| measure.help);
        let message = |(name, value): &(String, f64)| v1::Measure {
            name: name.clone(),
            value: *value,
            help: help(name).unwrap_or_default().to_owned(),
        };
        self.0.iter().map(message).collect()
    }
}

impl Serialize for Measured {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut map = serializer.serialize_map(Some(self.0.len()))?;
        for (name, value) in &self.0 {
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
                while let Some(entry) = map.next_entry()? {
                    measured.0.push(entry);
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
        let measured = Measured(vec![("td_loss".into(), 0.5), ("grad_norm".into(), 1e-9)]);
        let line = Line { env_steps: 7, measured };
        let text = serde_json::to_string(&line).unwrap();
        assert_eq!(text, r#"{"env_steps":7,"td_loss":0.5,"grad_norm":1e-9}"#);
        assert_eq!(serde_json::from_str::<Line>(&text).unwrap(), line);
        let measures = [Measure { name: "grad_norm", help: "Gradient norm" }];
        let messages = line.measured.to_messages(&measures);
        let told: Vec<_> = messages.iter().map(|it| (it.name.as_str(), it.value, it.help.as_str())).collect();
        assert_eq!(told, [("td_loss", 0.5, ""), ("grad_norm", 1e-9, "Gradient norm")]);
    }
}
