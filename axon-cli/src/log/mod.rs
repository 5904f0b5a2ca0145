//! Recorded logs: MCAP in, topics and messages out.
//!
//! A file is read as a stream, so memory follows its largest chunk and not its size; [`Log::load`]
//! alone holds a whole log, for comparisons.

mod coverage;

use std::{
    fs::File,
    io::{BufReader, ErrorKind, Read},
    path::{Path, PathBuf},
};

use mcap::{
    McapError,
    sans_io::{LinearReaderOptions, MessageReadEvent, MessageReader},
};

use coverage::Coverage;

/// Longest record that is read, in bytes: no message may be larger on the wire either.
const RECORD_LIMIT: usize = 1 << 30;

/// What was recorded under one topic name and one type.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Topic {
    /// Topic name as recorded.
    pub(crate) name: String,
    /// Type name as ROS spells it, such as `sensor_msgs/msg/LaserScan`.
    pub(crate) type_name: String,
}

/// One recorded message.
#[derive(Debug)]
pub(crate) struct Message {
    /// Index into the log's topics.
    pub(crate) topic: usize,
    /// When it was recorded, in nanoseconds of the recorder's clock.
    pub(crate) time: u64,
    /// The serialized message.
    pub(crate) data: Vec<u8>,
}

/// What a log holds, without its messages.
#[derive(Clone, Debug)]
pub(crate) struct Survey {
    /// Where the log is.
    pub(crate) path: PathBuf,
    /// Topics, in the order of their first message.
    pub(crate) topics: Vec<Topic>,
    /// Number of messages.
    pub(crate) messages: u64,
    /// Sum of the messages' sizes in bytes.
    pub(crate) bytes: u64,
    /// Largest message in bytes.
    pub(crate) largest: u64,
    /// Time from the earliest to the latest message, in nanoseconds.
    pub(crate) duration: u64,
    /// What ends the log early, where only its whole part was asked for.
    pub(crate) damage: Option<String>,
    /// Messages of a damaged log that no checksum covers.
    pub(crate) unverified: u64,
}

/// What is read of a damaged log.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Part {
    /// Nothing.
    Nothing,
    /// What precedes the damage, if a checksum covers all of it.
    Verified,
    /// What precedes the damage.
    Unverified,
}

/// Why a log cannot be read.
#[derive(Debug, thiserror::Error)]
pub(crate) enum LogError {
    #[error("cannot open the log {path}: {source}")]
    Open { path: PathBuf, source: std::io::Error },
    #[error("cannot read the log {path}: {source}")]
    Read { path: PathBuf, source: std::io::Error },
    #[error("{path} is not an MCAP log: it does not begin with the magic number")]
    NoLog { path: PathBuf },
    #[error("{path} is damaged: {source}; {}", whole(*messages, *unverified, *seconds))]
    Damaged { path: PathBuf, messages: u64, unverified: u64, seconds: f64, source: McapError },
    #[error("{path} changed while it was read: fewer messages are whole than at the start")]
    Changed { path: PathBuf },
    #[error("{path} holds no messages")]
    Empty { path: PathBuf },
}

/// What can be had of a damaged log.
fn whole(messages: u64, unverified: u64, seconds: f64) -> String {
    match (messages, unverified) {
        (0, _) => "no message before that is whole".to_owned(),
        (_, 0) => format!(
            "the {messages} messages ({seconds:.1} s) before that are whole, and `axon play --incomplete` \
             publishes them"
        ),
        _ => format!(
            "of the {messages} messages ({seconds:.1} s) before that {unverified} are covered by no checksum \
             that was right, and may be wrong; `axon play --incomplete --unverified` publishes all of them"
        ),
    }
}

impl Survey {
    /// Reads the log once from end to end, checksums included.
    ///
    /// # Errors
    /// [`LogError::Damaged`] where a part of the log is missing or fails its checksum.
    pub(crate) fn of(path: &Path) -> Result<Self, LogError> {
        Self::of_part(path, Part::Nothing)
    }

    /// As [`Survey::of`], but of a damaged log this part.
    ///
    /// # Errors
    /// [`LogError::Damaged`] where the log is damaged and that part is not to be had.
    pub(crate) fn of_part(path: &Path, part: Part) -> Result<Self, LogError> {
        let (mut survey, damage) = Self::read(path)?;
        let Some(source) = damage else {
            return if survey.messages > 0 {
                Ok(survey)
            } else {
                Err(LogError::Empty { path: survey.path })
            };
        };
        let wanted = match part {
            Part::Nothing => false,
            Part::Verified => survey.unverified == 0,
            Part::Unverified => true,
        };
        if wanted && survey.messages > 0 {
            survey.damage = Some(source.to_string());
            return Ok(survey);
        }
        Err(LogError::Damaged {
            path: survey.path,
            messages: survey.messages,
            unverified: survey.unverified,
            seconds: survey.duration as f64 / 1e9,
            source,
        })
    }

    /// The messages before the first damage, and the damage.
    fn read(path: &Path) -> Result<(Self, Option<McapError>), LogError> {
        let mut survey = Self {
            path: path.to_owned(),
            topics: Vec::new(),
            messages: 0,
            bytes: 0,
            largest: 0,
            duration: 0,
            damage: None,
            unverified: 0,
        };
        let (mut first, mut last) = (u64::MAX, 0);
        let mut messages = Messages::open(path, Vec::new(), Checks::Whole)?;
        let damage = loop {
            let message = match messages.advance() {
                Ok(Some(message)) => message,
                Ok(None) => break None,
                Err(End::Read(source)) => {
                    return Err(LogError::Read { path: path.to_owned(), source });
                }
                Err(End::Damage(_)) if !messages.coverage.is_log() => {
                    return Err(LogError::NoLog { path: path.to_owned() });
                }
                Err(End::Damage(error)) => break Some(error),
            };
            survey.messages += 1;
            survey.bytes += message.data.len() as u64;
            survey.largest = survey.largest.max(message.data.len() as u64);
            (first, last) = (first.min(message.time), last.max(message.time));
        };
        survey.duration = last.saturating_sub(first);
        survey.unverified = damage.as_ref().map_or(0, |error| messages.coverage.unverified(error));
        survey.topics = messages.topics;
        Ok((survey, damage))
    }

    /// The surveyed messages in the order of the file, with indexes into this survey's topics.
    pub(crate) fn messages(
        &self,
    ) -> Result<impl Iterator<Item = Result<Message, LogError>> + Send + use<>, LogError> {
        let mut messages = Messages::open(&self.path, self.topics.clone(), Checks::Chunks)?;
        let mut left = self.messages;
        Ok(std::iter::from_fn(move || {
            left = left.checked_sub(1)?;
            let ended = match messages.advance() {
                Ok(Some(message)) => return Some(Ok(message)),
                ended => ended,
            };
            left = 0;
            let path = messages.path.clone();
            Some(Err(match ended {
                Err(End::Read(source)) => LogError::Read { path, source },
                _ => LogError::Changed { path },
            }))
        }))
    }
}

/// A whole log in memory.
#[derive(Debug)]
pub(crate) struct Log {
    /// What it holds.
    pub(crate) survey: Survey,
    /// For each topic its messages, in the order of the file.
    pub(crate) payloads: Vec<Vec<Vec<u8>>>,
}

impl Log {
    /// Reads every message into memory.
    pub(crate) fn load(path: &Path) -> Result<Self, LogError> {
        let survey = Survey::of(path)?;
        let mut payloads = vec![Vec::new(); survey.topics.len()];
        for message in survey.messages()? {
            let message = message?;
            payloads[message.topic].push(message.data);
        }
        Ok(Self { survey, payloads })
    }
}

/// Which checksums are compared.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Checks {
    /// Of each chunk, before its first message is handed out.
    Chunks,
    /// Those of the chunks, and that of the data section.
    Whole,
}

/// Why no further message can be read.
#[derive(Debug)]
enum End {
    /// The file cannot be read.
    Read(std::io::Error),
    /// It can, and is no whole log.
    Damage(McapError),
}

struct Messages {
    path: PathBuf,
    file: BufReader<File>,
    reader: MessageReader,
    coverage: Coverage,
    topics: Vec<Topic>,
}

impl Messages {
    fn open(path: &Path, topics: Vec<Topic>, checks: Checks) -> Result<Self, LogError> {
        let file =
            File::open(path).map_err(|source| LogError::Open { path: path.to_owned(), source })?;
        let options = LinearReaderOptions::default()
            .with_record_length_limit(RECORD_LIMIT)
            .with_prevalidate_chunk_crcs(true)
            .with_validate_data_section_crc(checks == Checks::Whole);
        Ok(Self {
            path: path.to_owned(),
            file: BufReader::new(file),
            reader: MessageReader::new_with_options(options),
            coverage: Coverage::default(),
            topics,
        })
    }

    /// The next message, or none at the end of a whole log.
    fn advance(&mut self) -> Result<Option<Message>, End> {
        let message = loop {
            match self.reader.next_event().transpose().map_err(End::Damage)? {
                None => return Ok(None),
                Some(MessageReadEvent::Message(message)) => break message,
                Some(MessageReadEvent::ReadRequest(length)) => self.fill(length)?,
            }
        };
        self.coverage.message();
        let type_name = message.channel.schema.as_ref().map_or("", |s| s.name.as_str());
        let name = message.channel.topic.as_str();
        let known = self.topics.iter().position(|t| t.name == name && t.type_name == type_name);
        let topic = known.unwrap_or_else(|| {
            self.topics.push(Topic { name: name.to_owned(), type_name: type_name.to_owned() });
            self.topics.len() - 1
        });
        Ok(Some(Message { topic, time: message.log_time, data: message.data.into_owned() }))
    }

    /// Reads up to `length` bytes of the file.
    fn fill(&mut self, length: usize) -> Result<(), End> {
        let room = self.reader.insert(length);
        let read = loop {
            match self.file.read(room) {
                Ok(read) => break read,
                Err(error) if error.kind() == ErrorKind::Interrupted => {}
                Err(error) => return Err(End::Read(error)),
            }
        };
        self.coverage.read(&room[..read]);
        self.reader.notify_read(read);
        Ok(())
    }
}

#[cfg(test)]
mod tests;
