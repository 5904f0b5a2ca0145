//! Recorded logs: MCAP in, topics and messages out.
//!
//! A file is read as a stream, so memory follows its largest chunk and not its size; [`Log::load`]
//! alone holds a whole log, for comparisons.

use std::{
    fs::File,
    io::BufReader,
    path::{Path, PathBuf},
};

use mcap::sans_io::LinearReaderOptions;

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
}

/// Why a log cannot be read.
#[derive(Debug, thiserror::Error)]
pub(crate) enum LogError {
    #[error("cannot open the log {path}: {source}")]
    Open { path: PathBuf, source: std::io::Error },
    #[error("{path} is not an MCAP log: {source}")]
    Read { path: PathBuf, source: mcap::McapError },
    #[error(
        "{path} is damaged: {source}; the {messages} messages ({seconds:.1} s) before that are whole, \
         and `axon play --incomplete` publishes them"
    )]
    Damaged { path: PathBuf, messages: u64, seconds: f64, source: mcap::McapError },
    #[error("{path} changed while it was read: fewer messages are whole than at the start")]
    Changed { path: PathBuf },
    #[error("{path} holds no messages")]
    Empty { path: PathBuf },
}

impl Survey {
    /// Reads the log once from end to end, checksums included.
    ///
    /// # Errors
    /// [`LogError::Damaged`] where a part of the log is missing or fails its checksum.
    pub(crate) fn of(path: &Path) -> Result<Self, LogError> {
        match Self::read(path)? {
            (survey, None) => Ok(survey),
            (survey, Some(source)) => Err(LogError::Damaged {
                path: survey.path,
                messages: survey.messages,
                seconds: survey.duration as f64 / 1e9,
                source,
            }),
        }
    }

    /// As [`Survey::of`], but of a damaged log its part before the damage.
    pub(crate) fn of_whole_part(path: &Path) -> Result<Self, LogError> {
        let (mut survey, damage) = Self::read(path)?;
        survey.damage = damage.map(|error| error.to_string());
        Ok(survey)
    }

    /// The messages before the first damage, and the damage.
    fn read(path: &Path) -> Result<(Self, Option<mcap::McapError>), LogError> {
        let mut survey = Self {
            path: path.to_owned(),
            topics: Vec::new(),
            messages: 0,
            bytes: 0,
            largest: 0,
            duration: 0,
            damage: None,
        };
        let mut span: Option<(u64, u64)> = None;
        let mut damage = None;
        let mut messages = Messages::open(path, Vec::new(), Checks::Whole)?;
        while let Some(message) = messages.advance() {
            let message = match message {
                Ok(message) => message,
                Err(LogError::Read { source, .. }) if survey.messages > 0 => {
                    damage = Some(source);
                    break;
                }
                Err(error) => return Err(error),
            };
            survey.messages += 1;
            survey.bytes += message.data.len() as u64;
            survey.largest = survey.largest.max(message.data.len() as u64);
            let (first, last) = span.unwrap_or((message.time, message.time));
            span = Some((first.min(message.time), last.max(message.time)));
        }
        let Some((first, last)) = span else {
            return Err(LogError::Empty { path: path.to_owned() });
        };
        survey.duration = last - first;
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
            let message = messages.advance();
            if !matches!(message, Some(Ok(_))) {
                left = 0;
            }
            message.or_else(|| Some(Err(LogError::Changed { path: messages.path.clone() })))
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

struct Messages {
    path: PathBuf,
    reader: mcap::io::MessageReader<BufReader<File>>,
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
        let reader = mcap::io::MessageReader::new_with_options(BufReader::new(file), options);
        Ok(Self { path: path.to_owned(), reader, topics })
    }

    fn advance(&mut self) -> Option<Result<Message, LogError>> {
        let message = match self.reader.next()? {
            Ok(message) => message,
            Err(source) => return Some(Err(LogError::Read { path: self.path.clone(), source })),
        };
        let type_name = message.channel.schema.as_ref().map_or("", |s| s.name.as_str());
        let name = message.channel.topic.as_str();
        let known = self.topics.iter().position(|t| t.name == name && t.type_name == type_name);
        let topic = known.unwrap_or_else(|| {
            self.topics.push(Topic { name: name.to_owned(), type_name: type_name.to_owned() });
            self.topics.len() - 1
        });
        Some(Ok(Message { topic, time: message.log_time, data: message.data.into_owned() }))
    }
}

#[cfg(test)]
mod tests {
    use std::{collections::BTreeMap, io::Write};

    use super::*;

    const RECORDED: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/data/mit-csail.mcap");

    fn file(bytes: &[u8]) -> tempfile::NamedTempFile {
        let mut file = tempfile::NamedTempFile::new().expect("temporary file");
        file.write_all(bytes).expect("write");
        file
    }

    #[test]
    fn a_file_that_is_no_log_is_an_error_that_names_it() {
        for bytes in [&b""[..], b"not a log", b"\x89MCAP0\r\n", &[0xff; 4096]] {
            let file = file(bytes);
            let error = Survey::of(file.path()).expect_err("refused").to_string();
            assert!(error.contains(&*file.path().to_string_lossy()), "{error}");
        }
        let missing = Path::new("/nonexistent/log.mcap");
        assert!(matches!(Survey::of(missing), Err(LogError::Open { .. })));
    }

    #[test]
    fn a_log_cut_anywhere_is_an_error_and_its_whole_part_is_readable() {
        let whole = std::fs::read(RECORDED).expect("the recorded log");
        let log = Log::load(Path::new(RECORDED)).expect("the recorded log");
        let mut found = 0;
        for cut in (0..whole.len()).step_by(whole.len() / 37) {
            let file = file(&whole[..cut]);
            let error = Survey::of(file.path()).expect_err("a cut log");
            let LogError::Damaged { messages, .. } = error else {
                assert!(Survey::of_whole_part(file.path()).is_err(), "cut at {cut}: {error}");
                continue;
            };
            assert!(error.to_string().contains("--incomplete"), "{error}");
            let part = Survey::of_whole_part(file.path()).expect("the part before the cut");
            assert!(messages >= found && part.messages == messages && part.damage.is_some());
            let mut heads = vec![0; part.topics.len()];
            for message in part.messages().expect("opens") {
                let message = message.expect("a whole message");
                let topic = &part.topics[message.topic];
                let same = log.survey.topics.iter().position(|t| t == topic).expect("recorded");
                assert_eq!(message.data, log.payloads[same][heads[message.topic]]);
                heads[message.topic] += 1;
            }
            assert_eq!(heads.iter().sum::<usize>() as u64, messages);
            found = messages;
        }
        assert!(found > 5_000, "the last cut leaves nearly all: {found}");
    }

    #[test]
    fn no_message_of_a_chunk_with_a_wrong_checksum_is_handed_out() {
        for compression in [None, Some(mcap::Compression::Zstd)] {
            let bytes = chunks_of_ten(3, compression);
            // The checksum follows two times and the uncompressed size in the chunk's header.
            let header = chunk_header(&bytes, 1);
            let mut wrong = bytes.clone();
            wrong[header + 24] ^= 1;
            let file = file(&wrong);
            let error = Survey::of(file.path()).expect_err("a wrong checksum");
            assert!(matches!(error, LogError::Damaged { messages: 10, .. }), "{error}");
            let part = Survey::of_whole_part(file.path()).expect("the first chunk");
            assert_eq!(part.messages().expect("opens").filter(Result::is_ok).count(), 10);
            assert!(Survey::of(self::file(&bytes).path()).is_ok());
        }
    }

    #[test]
    fn a_log_that_shrinks_between_survey_and_replay_is_an_error() {
        let bytes = chunks_of_ten(3, None);
        let file = file(&bytes);
        let survey = Survey::of(file.path()).expect("a whole log");
        file.as_file().set_len(chunk_header(&bytes, 2) as u64).expect("truncate");
        let read: Vec<_> = survey.messages().expect("opens").collect();
        assert_eq!(read.iter().filter(|message| message.is_ok()).count(), 20);
        assert!(read.last().expect("an error").is_err());
    }

    /// A log of `count` chunks with ten messages each.
    fn chunks_of_ten(count: u64, compression: Option<mcap::Compression>) -> Vec<u8> {
        let mut writer = mcap::WriteOptions::new()
            .compression(compression)
            .create(std::io::Cursor::new(Vec::new()))
            .expect("writer");
        let channel = writer.add_channel(0, "/t", "cdr", &BTreeMap::new()).expect("channel");
        for number in 0..count * 10 {
            let header = mcap::records::MessageHeader {
                channel_id: channel,
                sequence: number as u32,
                log_time: number,
                publish_time: number,
            };
            writer.write_to_known_channel(&header, &number.to_le_bytes()).expect("message");
            if number % 10 == 9 {
                writer.flush().expect("end of a chunk");
            }
        }
        writer.finish().expect("finish");
        writer.into_inner().into_inner()
    }

    /// Where the body of the chunk of this index begins.
    fn chunk_header(bytes: &[u8], index: usize) -> usize {
        const CHUNK: u8 = 6;
        let mut at = mcap::MAGIC.len();
        let mut chunks = 0;
        loop {
            let body = at + 9;
            let length = bytes[at + 1..body].try_into().expect("eight bytes");
            if bytes[at] == CHUNK {
                if chunks == index {
                    return body;
                }
                chunks += 1;
            }
            at = body + u64::from_le_bytes(length) as usize;
        }
    }

    #[test]
    fn a_record_of_absurd_length_is_refused_without_allocating_it() {
        let mut bytes = mcap::MAGIC.to_vec();
        bytes.push(0x05);
        bytes.extend_from_slice(&(1_u64 << 62).to_le_bytes());
        assert!(matches!(Survey::of(file(&bytes).path()), Err(LogError::Read { .. })));
    }

    #[test]
    fn the_recorded_log_reads_as_its_attribution_says() {
        let log = Log::load(Path::new(RECORDED)).expect("the recorded log");
        assert_eq!(log.survey.messages, 5_964);
        assert_eq!((log.survey.duration as f64 / 1e9).round(), 424.0);
        let scans = log
            .survey
            .topics
            .iter()
            .position(|t| t.name == "/scan" && t.type_name == "sensor_msgs/msg/LaserScan")
            .expect("the laser's topic");
        assert_eq!(log.payloads[scans].len(), 1_988);
        let bytes: usize = log.payloads.iter().flatten().map(Vec::len).sum();
        assert_eq!(bytes as u64, log.survey.bytes);
    }

    #[test]
    fn channels_of_one_topic_and_type_are_one_topic() {
        let mut writer = mcap::Writer::new(std::io::Cursor::new(Vec::new())).expect("writer");
        let schema = writer.add_schema("a/msg/B", "ros2msg", b"").expect("schema");
        for callerid in ["one", "two"] {
            let metadata = BTreeMap::from([("callerid".to_owned(), callerid.to_owned())]);
            let channel = writer.add_channel(schema, "/t", "cdr", &metadata).expect("channel");
            let header = mcap::records::MessageHeader {
                channel_id: channel,
                sequence: 1,
                log_time: 1,
                publish_time: 1,
            };
            writer.write_to_known_channel(&header, callerid.as_bytes()).expect("message");
        }
        writer.finish().expect("finish");
        let file = file(&writer.into_inner().into_inner());
        let log = Log::load(file.path()).expect("log");
        assert_eq!(log.survey.topics.len(), 1);
        assert_eq!(log.payloads, [[b"one".to_vec(), b"two".to_vec()]]);
    }
}
